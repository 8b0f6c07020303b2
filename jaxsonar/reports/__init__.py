"""Reports: figures, tables for the terminal, and HTML pages.

Entry points: one function per figure in ``plot_scan``, ``plot_map``, ``plot_slam``, ``plot_calibration`` and
``plot_health``; colors, plan views and ``save_figure`` in ``plot_style``; ``*_table`` in ``terminal_tables``;
``save_report`` in ``html_page``.

Design decisions:

- A function draws one figure and returns it; saving is separate. The same figure gives the same bytes.
- An HTML page contains its figures and needs neither network nor scripts.
"""
