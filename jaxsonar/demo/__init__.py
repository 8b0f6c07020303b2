"""The demo program behind ``jaxsonar demo``: the embedded office, its map, and 200 random poses, as files and a page.

Entry point: ``run_demo.run_demo``. ``comparison`` computes the rows of the tables, ``demo_page`` draws the figures and
writes the page.
"""
