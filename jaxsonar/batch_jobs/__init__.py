"""Batch processing: any number of logs to Parquet tables of lines and points, in shards and in parallel.

Entry point: ``run_batch.batch``. It finds the inputs (``inputs``), splits them into shards (``shards``, with
``parquet_staging`` for inputs that must be read as a whole), runs the shards on an executor (``process_pool`` or
``dask_cluster``, both call ``worker.run_shard``), and records results and progress in a manifest (``manifest``).

Design decisions:

- Shards depend on the inputs alone. Neither workers nor executor decide which scans are computed together, every worker
  runs one thread, and only one process writes. Therefore the bytes of the results are always the same. The lines of the
  manifest are sorted at the end.
- Workers are plain processes with a socket, not a pool of ``multiprocessing``. A worker that dies is known and
  replaced, the caller's program is not loaded again in each worker, and workers end with their parent process.
- Unreadable scans are found by bisection. The reader of runs of scans is the only reader; only where it fails are
  smaller runs read, down to single scans.
"""
