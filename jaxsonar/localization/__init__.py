"""Localization in a known map. Entry point: ``localize.localize``.

``known_map`` holds the map as landmarks, ``hypothesis_tracking`` tracks pose hypotheses through the first scans.

Decision: no pose is guessed. If several poses are possible, they are reported, and no trajectory is returned.
"""
