"""Recordings: readers of any robot's files."""
