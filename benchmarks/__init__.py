"""Benchmarks: one file a workload, run as ``python -m benchmarks.NAME``."""
