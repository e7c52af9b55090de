"""MegaPose's geometry written out in numbers, one at a time, from what is known of its release."""

import math

import numpy as np


def project(K, T, point, near=0.0):
    x, y, z = (sum(T[i][j] * point[j] for j in range(3)) + T[i][3] for i in range(3))
    depth = max(z, near)
    return (K[0][0] * x + K[0][2] * z) / depth, (K[1][1] * y + K[1][2] * z) / depth


def crop_box(points, K, T, near=0.1, height=240, width=320):
    pixels = [project(K, T, point, near) for point in points]
    u, v = project(K, T, (0.0, 0.0, 0.0), near)
    left, right = min(p[0] for p in pixels), max(p[0] for p in pixels)
    top, bottom = min(p[1] for p in pixels), max(p[1] for p in pixels)
    dx, dy = max(abs(left - u), abs(right - u)), max(abs(top - v), abs(bottom - v))
    ratio = width / height
    w = 2 * 1.4 * max(dx, ratio * dy)
    h = w / ratio
    return u - w / 2, v - h / 2, u + w / 2, v + h / 2


def crop_intrinsics(K, box, height=240, width=320):
    w, h = box[2] - box[0], box[3] - box[1]
    u, v = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
    cx, cy = K[0][2] + (w - 1) / 2 - u, K[1][2] + (h - 1) / 2 - v
    sx, sy = width / w, height / h
    cx = (width - 1) / 2 + sx * (cx - (w - 1) / 2)
    cy = (height - 1) / 2 + sy * (cy - (h - 1) / 2)
    return [[sx * K[0][0], 0.0, cx], [0.0, sy * K[1][1], cy], [0.0, 0.0, 1.0]]


def unit(a):
    length = math.sqrt(sum(x * x for x in a))
    return [x / length for x in a]


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def looking_camera(position, target, up):
    """``T_camera_from_looker``: at a position, looking at a target, with an up direction as near as may be."""
    forward = unit([t - p for t, p in zip(target, position, strict=True)])
    right = unit(cross(forward, up))
    down = cross(forward, right)
    return [[right[i], down[i], forward[i], position[i]] for i in range(3)] + [[0.0, 0.0, 0.0, 1.0]]


def four_views(T):
    target = [T[i][3] for i in range(3)]
    up = [0.0, -1.0, 0.0]
    distance = math.sqrt(sum(x * x for x in target))
    right = [row[0] for row in looking_camera([0.0, 0.0, 0.0], target, up)[:3]]
    views = [np.array(T)]
    for side in (0.0, 1.0, -1.0):
        position = [side * distance * x for x in right]
        views.append(np.linalg.inv(np.array(looking_camera(position, target, up))) @ np.array(T))
    return views


def updated(T, K, nine):
    """Nine numbers in the network's order: two columns, vx, vy, vz."""
    a, b, (vx, vy, vz) = list(nine[:3]), list(nine[3:6]), nine[6:]
    x = unit(a)
    z = unit(cross(x, b))
    y = cross(z, x)
    turn = [[x[i], y[i], z[i]] for i in range(3)]
    depth = vz * T[2][3]
    t = [
        (vx / K[0][0] + T[0][3] / T[2][3]) * depth,
        (vy / K[1][1] + T[1][3] / T[2][3]) * depth,
        depth,
    ]
    rows = [[sum(turn[i][k] * T[k][j] for k in range(3)) for j in range(3)] + [t[i]] for i in range(3)]
    return [*rows, [0.0, 0.0, 0.0, 1.0]]


def bilinear(image, v, u):
    """RoIAlign's: repeated for a pixel beyond the outermost centres, zero further out."""
    height, width = len(image), len(image[0])
    if v < -1.0 or v > height or u < -1.0 or u > width:
        return 0.0
    v, u = min(max(v, 0.0), height - 1.0), min(max(u, 0.0), width - 1.0)
    row, column = int(v), int(u)
    below, beside = min(row + 1, height - 1), min(column + 1, width - 1)
    dv, du = v - row, u - column
    top = (1 - du) * image[row][column] + du * image[row][beside]
    bottom = (1 - du) * image[below][column] + du * image[below][beside]
    return (1 - dv) * top + dv * bottom


def roi_align(image, box, height, width, samples=4):
    w, h = max(box[2] - box[0], 1.0) / width, max(box[3] - box[1], 1.0) / height
    out = np.zeros((height, width))
    for i in range(height):
        for j in range(width):
            for a in range(samples):
                for b in range(samples):
                    v = box[1] + (i + (a + 0.5) / samples) * h
                    u = box[0] + (j + (b + 0.5) / samples) * w
                    out[i, j] += bilinear(image, v, u) / samples**2
    return out
