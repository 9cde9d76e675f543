"""wip"""

from __future__ import annotations
import time
from concurrent.futures import ThreadPoolExecutor
import numpy as np
from dcreg.box import Box, LongestEdge
from dcreg.kernels import rigid as kernels
from dcreg.models.base import mean_of_largest
from dcreg.rotation import RotationModel
from dcreg.search import Evaluation, Limits, branch_and_bound


class RigidModel:
    def __init__(self, source, target, n_inliers, reduced_box=True):
        self.source = np.ascontiguousarray(source.T)
        self.target = np.ascontiguousarray(target.T)
        self.k = n_inliers
        self.reduced_box = reduced_box

    def roots(self):
        reach = subset_reach(self.source.T, self.k)
        low = np.array([-mean_of_largest(-y, self.k) for y in self.target]) - reach
        high = np.array([mean_of_largest(y, self.k) for y in self.target]) + reach
        low, high = (np.where(np.abs(v) < 1e-12, 0.0, v) for v in (low, high))
        out = []
        for r in RotationModel.roots():
            out.append(Box(np.r_[r.lower, low], np.r_[r.upper, high]))
        return out

    def refine(self, theta):
        t, v, s = kernels.refine(theta, self.source, self.target, self.k)
        t[:4] /= t[:4][np.argmax(np.abs(t[:4]))]
        return t, v, s


def subset_reach(points, k):
    if k == len(points):
        return np.linalg.norm(points.mean(0)) if np.linalg.norm(points.mean(0)) > 1e-12 else 0.0
    n = 400
    i = np.arange(n) + 0.5
    phi = np.arccos(1 - 2 * i / n)
    th = np.pi * (1 + 5**0.5) * i
    d = np.stack([np.cos(th) * np.sin(phi), np.sin(th) * np.sin(phi), np.cos(phi)])
    return np.sort(points @ d, axis=0)[-k:].mean(0).max() * 1.02


class RigidBound:
    def __init__(self, model, effort=0.3):
        self.model = model
        self.n_assignments = 0
        self.effort, self.effort2 = effort if isinstance(effort, tuple) else (effort, .5)
        self.work = np.zeros(8, dtype=np.int64)

    def evaluate(self, lower, upper, cutoff):
        b, v = np.empty(len(lower)), np.empty(len(lower))
        m = self.model
        self.n_assignments += kernels.bound_boxes(
            lower, upper, cutoff, m.source, m.target, m.k, self.effort, self.effort2, b, v, self.work
        )
        return Evaluation(b, 0.5 * (lower + upper), v)
