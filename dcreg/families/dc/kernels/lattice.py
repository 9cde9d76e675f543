"""Vertices of bisected boxes, identified by their position on a dyadic lattice of the root box.

A vertex is stored once, under its integer coordinates, for all boxes that have it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dcreg.assignment.kernels.selection import cleared
from dcreg.families.dc.kernels.boxes import n_vertices, vertex
from dcreg.jit import jit, jit_part

CELLS = 2.0**30  # per axis; finer boxes are not distinguished


class Lattice(NamedTuple):
    """The vertices seen so far, by slot, and a hash table to find them.

    Attributes
    ----------
    table : (T,) int array
        Slots by hash, -1 where empty; T is a power of two.
    keys : (S, 4) int array
        Coordinates on the lattice.
    thetas : (S, dim) array
    met : (S,) int array
        The last call that requested the vertex.
    origin, width : (dim,) arrays
        Of the root box.
    """

    table: np.ndarray
    keys: np.ndarray
    thetas: np.ndarray
    met: np.ndarray
    origin: np.ndarray
    width: np.ndarray


class Vertices(NamedTuple):
    """Values and bounds of the vertices, by slot.

    Attributes
    ----------
    thetas : (S, dim) array
    lows : (S,) array
        Lower bounds on E.
    values : (S,) array
        E if it was solved, otherwise infinite.
    levels : (S,) array
        Approximately the k-th smallest entry of the profile.
    profiles, duals : (S, n), (S, m) arrays
    """

    thetas: np.ndarray
    lows: np.ndarray
    values: np.ndarray
    levels: np.ndarray
    profiles: np.ndarray
    duals: np.ndarray


@jit_part
def _hash(q0, q1, q2, q3):
    h = np.uint64(q0) * np.uint64(0x9E3779B97F4A7C15)
    h = (h ^ np.uint64(q1)) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(29)) ^ np.uint64(q2)) * np.uint64(0x94D049BB133111EB)
    h = (h ^ (h >> np.uint64(32)) ^ np.uint64(q3)) * np.uint64(0x9E3779B97F4A7C15)
    return h ^ (h >> np.uint64(31))


@jit
def rebuild(table, keys, used):
    """Build the hash table of the first `used` keys."""
    for at in range(table.size):
        table[at] = -1
    mask = np.uint64(table.size - 1)
    for slot in range(used):
        at = _hash(keys[slot, 0], keys[slot, 1], keys[slot, 2], keys[slot, 3]) & mask
        while table[at] >= 0:
            at = (at + np.uint64(1)) & mask
        table[at] = slot


@jit
def find_or_add(lattice, used, call, lower, upper, slots):
    """Return the slot of each distinct vertex of each box (-1 beyond the last); append new ones.

    Returns the number of slots in use; before the call it was `used`. The caller provides enough slots.
    """
    table, keys, dim = lattice.table, lattice.keys, lattice.origin.size
    mask = np.uint64(table.size - 1)
    theta, q = np.empty(dim), cleared(np.empty(4, np.int64))
    for box in range(lower.shape[0]):
        slots[box, 0] = -1
        for index in range(n_vertices(lower[box], upper[box])):
            vertex(lower[box], upper[box], index, theta)
            for a in range(dim):
                if lattice.width[a] > 0.0:
                    place = (theta[a] - lattice.origin[a]) / lattice.width[a]
                    q[a] = np.int64(np.rint(place * CELLS))
            at = _hash(q[0], q[1], q[2], q[3]) & mask
            slot = table[at]
            while slot >= 0 and (
                keys[slot, 0] != q[0]
                or keys[slot, 1] != q[1]
                or keys[slot, 2] != q[2]
                or keys[slot, 3] != q[3]
            ):
                at = (at + np.uint64(1)) & mask
                slot = table[at]
            if slot < 0:
                slot = used
                used += 1
                table[at] = slot
                for a in range(4):
                    keys[slot, a] = q[a]
                for a in range(dim):
                    lattice.thetas[slot, a] = theta[a]
            slots[box, index] = slot
            lattice.met[slot] = call
    return used
