"""Live processing: from a device to lines and a growing map, scan by scan.

Entry points: ``stream.stream`` runs the whole loop; ``live_map.LiveMap`` processes raw scans without it;
``rerun_viewer.RerunViewer`` shows a stream; ``replay`` plays logs and raw recordings as devices.

Design decisions:

- A robot that moves during a scan moves the echo paths, not the echoes. Each path fires once per scan, so a moved scan
  is a scan of a ring of another shape: the same compiled programs with other arrays. A scan has the pose and the stamp
  of its first firing group.
- Paths of a firing group that did not arrive were not measured; they are evidence neither for nor against a wall.
- Lines are computed at once; the map is updated when no scan waits. An occupancy grid is updated in a thread of its
  own, because an update takes seconds and may compile.
- The compiler runs in the background while the first scans are recorded and queued.
"""
