"""Scan logs: their file formats, sliding windows, and the packing of echoes into batches for kernels.

Entry points: ``log_file.load_scan_log``, ``log_file.save_log``, ``scan_log.Log``,
``flat_echoes.FlatEchoes``, ``echo_batches.pack``, ``sliding_windows.gather_windows``.

Design decisions:

- Batches have few different shapes, so that few programs are compiled and none per scan (``echo_batches.BatchPolicy``).
- Parquet logs are recorded by way of a CSV journal, because a Parquet file cannot be read before its footer is written.
  The marker file ``LOG.recording`` holds the number of bytes of complete scans.
- Readers of chunks locate scans without loading the file, so that logs of any size can be processed.
"""
