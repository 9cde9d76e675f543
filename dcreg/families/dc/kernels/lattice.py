"""Vertices of boxes made by bisection, told apart by their place on a dyadic lattice of the root box.

A vertex is stored once under its integer coordinates, whichever boxes it belongs to.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dcreg.families.dc.kernels.boxes import n_vertices, vertex
from dcreg.jit import jit, jit_part

CELLS = 2.0**30  # per axis; finer boxes are not told apart


class Lattice(NamedTuple):
    """The vertices met so far, by slot, and a hash table to find them.

    Attributes
    ----------
    table : (T,) int array
        Slots by hash, -1 where empty; T is a power of two.
    keys : (S, 4) int array
        Coordinates on the lattice.
    thetas : (S, dim) array
    met : (S,) int array
        The call that asked for the vertex last.
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
    """What is known of the vertices, by slot.

    Attributes
    ----------
    thetas : (S, dim) array
    lows : (S,) array
        Lower bounds on E.
    values : (S,) array
        E where it was solved, else infinite.
    levels : (S,) array
        About the k-th smallest entry of the profile.
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
    """Hash table over the first `used` keys."""
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
    """Slot of every distinct vertex of every box (-1 beyond the last); new ones are appended.

    Returns the number of slots in use, `used` of which were before. The caller guarantees room.
    """
    table, keys, dim = lattice.table, lattice.keys, lattice.origin.size
    mask = np.uint64(table.size - 1)
    theta, q = np.empty(dim), np.zeros(4, np.int64)
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
