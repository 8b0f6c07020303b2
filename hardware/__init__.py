"""Device interface: bytes on a link on one side, messages and raw scans on the other. Imports no JAX.

Entry points: ``open_source`` (client transports), ``protocol.Decoder`` and ``protocol.encode`` (wire format),
``ScanAssembler`` (firing groups to scans), ``ReaderThread`` (all of it in one thread), ``open_recorder`` (recordings),
``emulate`` with ``listen`` (an emulated device), ``read_corridor8`` and the other readers of published data sets.

Design decisions:

- This package is a leaf. It imports neither ``jaxsonar`` nor JAX, so that a robot's driver process starts fast.
- ``SonarError`` is defined here, because this is the lowest layer that raises it.
- A group whose pose may be stale has no pose. Where a gap in the sequence numbers can hide a pose message, the pose is
  unknown. A scan that is missing from the map is better than a wall in the wrong place.
- The recorder comes before the queue, so a scan that the queue drops is still in the recording.
- A device that runs ahead of its own clock is a replay and can wait. The reader then applies backpressure instead of
  dropping scans, on links that buffer what is not read (tcp, files).
"""

from .errors import SonarError as SonarError
