"""Information of a scan about the pose, without noise of normals; docs/estimator.md, [15], [22]."""

import math

import numpy as np

from service.kernels.compiled import inner_kernel
from service.kernels.linear3 import diagonalise_3x3

CLUSTER_BEAMS = 16  # neighbours whose normals are computed from mostly the same points


@inner_kernel
def chance_variance(evidence, along):
    """Variance of `shared` along a direction by chance alone; [22].

    The scan's normals are instruments for those of the surfels: their difference is the scan's own noise. It
    is correlated between neighbours, so CLUSTER_BEAMS beams form a cluster.

    evidence   (N, 7) float64   from surfel_normal_equations
    along      (3,)   float64   over x, y, theta
    Source: Liang, Zeger, Longitudinal data analysis using generalized linear models, 1986.
    """
    variance = 0.0
    total = 0.0
    for i in range(evidence.shape[0]):
        if i % CLUSTER_BEAMS == 0:
            variance += total * total
            total = 0.0
        if evidence[i, 0] > 0.0:
            j = along[0] * evidence[i, 1] + along[1] * evidence[i, 2] + along[2] * evidence[i, 3]
            differs = along[0] * evidence[i, 4] + along[1] * evidence[i, 5] + along[2] * evidence[i, 6]
            total += evidence[i, 0] * j * differs
    return variance + total * total


@inner_kernel
def scan_information(H, shared, evidence, chance_chi2, damping, information):
    """Information of a scan about the pose, and the damping of its gradient; [15].

    The gradient g has the covariance H and the sensitivity `shared`. The damping is shared H^-1 and the
    information shared H^-1 shared (Godambe 1960). Where both normals agree all three are equal; along a bare
    corridor they vanish. By chance `shared` may be negative or above H: its eigenvalues relative to H are
    limited to 0..1. Limited values have a positive mean, so chance is subtracted before; [22].

    H, shared              (3, 3) float64   from surfel_normal_equations
    evidence               (N, 7) float64   from there
    chance_chi2            float            squared sigmas of chance to subtract; 0: none
    damping, information   (3, 3) float64   out
    """
    L = np.empty((3, 3))
    inverse = np.empty((3, 3))
    whitened = np.empty((3, 3))
    scaled = np.empty((3, 3))
    axes = np.empty((3, 3))
    unit = np.ones(3)
    information[:, :] = 0.0
    damping[:, :] = 0.0
    trace = H[0, 0] + H[1, 1]
    if trace <= 0.0 or H[2, 2] <= 0.0:
        return
    # Axes of H with theta scaled like the position, so that an unobservable direction is an axis.
    unit[2] = math.sqrt(0.5 * trace / H[2, 2])
    for i in range(3):
        for j in range(3):
            scaled[i, j] = unit[i] * H[i, j] * unit[j]
    diagonalise_3x3(scaled, axes)
    for m in range(3):
        root = math.sqrt(max(scaled[m, m], 1e-9 * trace + 1e-6))
        for i in range(3):
            L[i, m] = axes[i, m] * root / unit[i]
            inverse[m, i] = axes[i, m] * unit[i] / root
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                for m in range(3):
                    total += inverse[i, k] * shared[k, m] * inverse[j, m]
            whitened[i, j] = total
    if chance_chi2 > 0.0:
        for m in range(3):
            shared_mm = whitened[m, m]
            kept = 0.0
            if shared_mm > 0.0:
                kept = max(
                    1.0 - chance_chi2 * chance_variance(evidence, inverse[m]) / (shared_mm * shared_mm), 0.0
                )
            for i in range(3):
                whitened[i, m] *= math.sqrt(kept)
                whitened[m, i] *= math.sqrt(kept)
    diagonalise_3x3(whitened, axes)
    out = np.zeros((3, 3))
    back = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                out[i, j] += L[i, k] * axes[k, j]
                back[i, j] += axes[k, i] * inverse[k, j]
    for m in range(3):
        part = min(max(whitened[m, m], 0.0), 1.0)
        for i in range(3):
            for j in range(3):
                damping[i, j] += out[i, m] * part * back[m, j]
                information[i, j] += out[i, m] * part * part * out[j, m]
