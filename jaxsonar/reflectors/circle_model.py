import numpy as np


def circle_range(center, radius, midpoint, half_baseline, steps=2):
    """center (...,2) radius (...), -> range, d_center (...,2), d_radius (...)."""
    tx, rx = midpoint - half_baseline - center, midpoint + half_baseline - center
    lt, lr = np.hypot(tx[..., 0], tx[..., 1]), np.hypot(rx[..., 0], rx[..., 1])
    bis = tx / lt[..., None] + rx / lr[..., None]
    lb = np.hypot(bis[..., 0], bis[..., 1])
    nx, ny = bis[..., 0] / lb, bis[..., 1] / lb
    a = radius + np.zeros_like(lt)
    for k in range(steps + 1):
        px, py = a * nx, a * ny
        dxt, dyt, dxr, dyr = tx[..., 0] - px, tx[..., 1] - py, rx[..., 0] - px, rx[..., 1] - py
        l1, l2 = np.sqrt(dxt * dxt + dyt * dyt), np.sqrt(dxr * dxr + dyr * dyr)
        e1x, e1y, e2x, e2y = dxt / l1, dyt / l1, dxr / l2, dyr / l2
        if k == steps:
            break
        # derivative of the half length by the angle, over a
        t1, t2 = -e1x * ny + e1y * nx, -e2x * ny + e2y * nx
        n1, n2 = e1x * nx + e1y * ny, e2x * nx + e2y * ny
        g = -(t1 + t2)
        h = (n1 + n2) + a * ((1 - t1 * t1) / l1 + (1 - t2 * t2) / l2)
        phi = np.clip(g / np.maximum(h, 1e-9), -0.5, 0.5)
        c, s = 1 - phi * phi / 2, -phi
        nx, ny = nx * c - ny * s, nx * s + ny * c
        ln = np.sqrt(nx * nx + ny * ny)
        nx, ny = nx / ln, ny / ln
    sx, sy = (e1x + e2x) / 2, (e1y + e2y) / 2
    return (l1 + l2) / 2, np.stack([-sx, -sy], -1), -(sx * nx + sy * ny)
