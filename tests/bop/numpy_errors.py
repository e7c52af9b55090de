"""BOP's pose errors in NumPy, one estimate at a time: the reference of tests and of the speed they ask for."""

import numpy as np


def transform(T, vertices):
    return vertices @ T[:3, :3].T + T[:3, 3]


def project(T, vertices, K):
    pixels = transform(T, vertices) @ K.T
    return pixels[:, :2] / pixels[:, 2:]


def mssd(T_est, T_true, vertices, symmetries):
    ours = transform(T_est, vertices)
    return min(np.linalg.norm(ours - transform(T_true @ S, vertices), axis=1).max() for S in symmetries)


def mspd(T_est, T_true, K, vertices, symmetries):
    ours = project(T_est, vertices, K)
    return min(np.linalg.norm(ours - project(T_true @ S, vertices, K), axis=1).max() for S in symmetries)


def add(T_est, T_true, vertices):
    return np.linalg.norm(transform(T_est, vertices) - transform(T_true, vertices), axis=1).mean()
