"""Reflectors that answer from several poses: found, fitted as plane, corner, edge or circle, and decided.

Entry point: ``find_reflectors.find_reflectors``. Walls and corners of a map come from local models (``mapping``); here
is what their echoes leave over, in the world frame.
"""
