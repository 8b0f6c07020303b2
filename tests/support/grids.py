"""Occupancy grids of known rooms, and their files as map_saver writes them."""

import numpy as np

from jaxsonar.geometry.se2 import inverse, transform_points


def rasterized(walls, resolution, origin, *, noise=0.0, gaps=0.0, seed=0):
    """Occupied and free cells of a closed room as a laser maps it.

    Occupied are the cells that samples of the walls hit, with noise, but for a fraction ``gaps``; the inside is free.
    """
    rng = np.random.default_rng(seed)
    samples = []
    for start, end in walls:
        count = int(np.linalg.norm(end - start) / 0.01)
        on = start + np.linspace(0, 1, count)[:, None] * (end - start)
        on = on[rng.random(count) > gaps]
        samples.append(on + rng.normal(0, noise, on.shape))
    cells = np.floor(transform_points(inverse(origin), np.concatenate(samples)) / resolution).astype(int)
    size = cells.max(axis=0) + 12
    x, y = (part.ravel() for part in np.meshgrid(*(np.arange(n) + 0.5 for n in size)))
    world = transform_points(origin, resolution * np.stack([x, y], axis=-1))
    a, b = walls[:, 0], walls[:, 1]
    # Even-odd rule.
    above = (a[:, 1] > world[:, 1:]) != (b[:, 1] > world[:, 1:])
    slope = np.divide(b[:, 0] - a[:, 0], b[:, 1] - a[:, 1], out=np.zeros(len(a)), where=b[:, 1] != a[:, 1])
    inside = (above & (world[:, :1] < a[:, 0] + (world[:, 1:] - a[:, 1]) * slope)).sum(axis=1) % 2 == 1
    occupied = np.zeros(size[::-1], dtype=bool)
    occupied[cells[:, 1], cells[:, 0]] = True
    return occupied, inside.reshape(occupied.shape) & ~occupied


def save_map_server(folder, occupied, free, resolution, origin):
    """Write MAP.yaml and MAP.pgm as map_saver does; returns the YAML file."""
    image = np.where(occupied, 0, np.where(free, 254, 205)).astype(np.uint8)[::-1]
    (folder / "map.pgm").write_bytes(b"P5\n%d %d\n255\n" % image.shape[::-1] + image.tobytes())
    values = f"resolution: {resolution}\norigin: [{origin[0]}, {origin[1]}, {origin[2]}]\n"
    thresholds = "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    (folder / "map.yaml").write_text("image: map.pgm\nmode: trinary\n" + values + thresholds)
    return folder / "map.yaml"
