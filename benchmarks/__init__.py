"""Benchmarks: ``python -m benchmarks`` for speed, and one file a workload, some with commands of their own."""
