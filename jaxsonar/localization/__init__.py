"""Localization in a known map. Entry point: ``localize.localize``.

``known_map`` holds the map as landmarks, ``hypothesis_generation`` finds pose hypotheses by features,
``hypothesis_tracking`` tracks them through the scans with ``scan_update``, a compiled update of many hypotheses at
once, and ``place_probabilities`` compares them.

Decision: no pose is guessed. If several poses are possible, they are reported with their probabilities, and no
trajectory is returned.
"""
