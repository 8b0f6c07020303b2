"""Detection of lines and points in scans: local environment models (paper, section 4).

Entry points: ``extract.extract_lines``, ``extract.local_model``, ``extract.local_models``. The algorithm of the paper
is ``hough_detector.hough_detections``; the default method is ``ml_detector.ml_detections``.

Design decisions:

- Seams of the parameter space, integer votes, the vote threshold, pieces of arcs: see ``jaxsonar.kernels``. Components
  and centroids respect both seams, too.
- A scan gives the same bits alone and in any batch: padding depends on the scan alone where floats are summed.
- Centroids are summed on the host over runs of points, along the memory. A GPU would wait for the components anyway.
- OpenCV labels only the rows with occupied cells, of all scans of a batch in one image.
- Lines and points are reported with a posterior probability of 0.7 or more; all others are reported as undecided with
  their probabilities. Direct echoes alone do not distinguish a corner from an edge.
- In windows of scans a post reflects into every pose, and its arcs intersect like those of a wall. A plane must explain
  4/3 of the echoes that a point explains.
"""
