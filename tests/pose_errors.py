"""MSSD, MSPD and average recall for tests, one estimate at a time."""

import numpy as np


def max_symmetric_errors(T_est, T_true, vertices, K, symmetries):
    """MSSD (mesh units) and MSPD (pixels) of one estimate, symmetries (S, 4, 4) included."""
    ours = vertices @ T_est[:3, :3].T + T_est[:3, 3]
    our_pixels = ours @ K.T
    our_pixels = our_pixels[:, :2] / our_pixels[:, 2:]
    surface, projection = [], []
    for S in symmetries:
        T = T_true @ S
        theirs = vertices @ T[:3, :3].T + T[:3, 3]
        their_pixels = theirs @ K.T
        their_pixels = their_pixels[:, :2] / their_pixels[:, 2:]
        surface.append(np.linalg.norm(ours - theirs, axis=1).max())
        projection.append(np.linalg.norm(our_pixels - their_pixels, axis=1).max())
    return min(surface), min(projection)


def average_recall(errors, thresholds):
    """Mean over the thresholds of the share of errors below."""
    return float((np.asarray(errors)[:, None] < np.asarray(thresholds)).mean())


def average_recalls(errors, diameters):
    """AR_MSSD and AR_MSPD of pairs (mssd, mspd); images 640 px wide."""
    mssd, mspd = np.asarray(errors).T
    steps = np.arange(1, 11)
    return average_recall(mssd / np.asarray(diameters), steps * 0.05), average_recall(mspd, steps * 5.0)
