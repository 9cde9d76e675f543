"""Pose graphs in the format of g2o, against the definition of its error."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import dcreg
from dcreg import PoseEdge


def rigid(seed, d=3):
    rng = np.random.default_rng(seed)
    T = np.eye(d + 1)
    angle = rng.uniform(-3, 3)
    c, s = np.cos(angle), np.sin(angle)
    turned = Rotation.random(random_state=seed).as_matrix() if d == 3 else [[c, -s], [s, c]]
    T[:d, :d], T[:d, d] = turned, rng.normal(size=d)
    return T


def covariance(seed, d=3, scale=1e-4):
    """A covariance of `Result`: rotation, translation, and in 2D a scale that is fixed."""
    free = 6 if d == 3 else 3
    factor = np.random.default_rng(seed).normal(size=(free, free))
    full = np.zeros((6, 6) if d == 3 else (4, 4))
    full[:free, :free] = scale * factor @ factor.T
    return full


def read(path):
    """Vertices and edges of a file: their numbers, by their ends."""
    vertices, edges = {}, {}
    for line in path.read_text().splitlines():
        tag, *fields = line.split()
        ends = 1 if tag.startswith("VERTEX") else 2
        key = tuple(map(int, fields[:ends]))
        (vertices if ends == 1 else edges)[key] = tag, np.array(fields[ends:], dtype=float)
    return vertices, edges


def matrix(numbers):
    """The pose of the numbers of g2o."""
    if len(numbers) == 3:
        x, y, a = numbers
        return np.array([[np.cos(a), -np.sin(a), x], [np.sin(a), np.cos(a), y], [0, 0, 1]])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(numbers[3:]).as_matrix(), numbers[:3]
    return T


def symmetric(upper, size):
    full = np.zeros((size, size))
    full[np.triu_indices(size)] = upper
    return full + np.triu(full, 1).T


def moved(T, xi):
    """T Exp(xi), with the rotation first."""
    twist = np.zeros_like(T)
    if len(T) == 4:
        a, b, c = xi[:3]
        twist[:3] = np.array([[0, -c, b, xi[3]], [c, 0, -a, xi[4]], [-b, a, 0, xi[5]]])
    else:
        twist[:2] = np.array([[0, -xi[0], xi[1]], [xi[0], 0, xi[2]]])
    return T @ expm(twist)


def error(measured, T):
    """The error of g2o: translation, then vector part of the quaternion, or angle."""
    rest = np.linalg.inv(measured) @ T
    if len(T) == 3:
        return np.array([*rest[:2, 2], np.arctan2(rest[1, 0], rest[0, 0])])
    turn = Rotation.from_matrix(rest[:3, :3]).as_quat()
    return np.array([*rest[:3, 3], *(turn[:3] * np.sign(turn[3]))])


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("seed", range(4))
def test_information_is_that_of_the_error_of_g2o(tmp_path, d, seed):
    """Errors of poses that vary by the covariance have the inverse of the information."""
    T, sigma = rigid(seed, d), covariance(seed, d)
    assert dcreg.write_pose_graph(tmp_path / "a.g2o", [PoseEdge(7, 3, T, sigma)]) == []
    _, edges = read(tmp_path / "a.g2o")
    tag, numbers = edges[3, 7]
    size, length = (6, 7) if d == 3 else (3, 3)
    assert tag == ("EDGE_SE3:QUAT" if d == 3 else "EDGE_SE2")
    assert len(numbers) == length + size * (size + 1) // 2
    measured = matrix(numbers[:length])
    np.testing.assert_allclose(measured, T, atol=1e-12)
    step = 1e-6
    jacobian = np.column_stack([
        (error(measured, moved(T, step * unit)) - error(measured, moved(T, -step * unit))) / (2 * step)
        for unit in np.eye(size)
    ])  # fmt: skip
    expected = jacobian @ sigma[:size, :size] @ jacobian.T
    information = symmetric(numbers[length:], size)
    np.testing.assert_allclose(information @ expected, np.eye(size), atol=1e-5)


@pytest.mark.parametrize("d", [2, 3])
def test_initial_poses_fit_the_edges_of_a_tree(tmp_path, d):
    """Two parts: 0 1 2 5 and 8 9."""
    ends = [(1, 0), (2, 1), (2, 5), (9, 8)]
    edges = [PoseEdge(*pair, rigid(at, d), covariance(at, d)) for at, pair in enumerate(ends)]
    dcreg.write_pose_graph(tmp_path / "a.g2o", edges)
    vertices, _ = read(tmp_path / "a.g2o")
    poses = {vertex: matrix(numbers) for (vertex,), (_, numbers) in vertices.items()}
    assert list(poses) == [0, 1, 2, 5, 8, 9]
    for root in (0, 8):
        np.testing.assert_allclose(poses[root], np.eye(d + 1), atol=1e-12)
    for source, target, T, _ in edges:
        np.testing.assert_allclose(np.linalg.inv(poses[target]) @ poses[source], T, atol=1e-9)


def test_without_a_covariance_the_information_is_the_identity(tmp_path):
    singular = covariance(0)
    singular[0], singular[:, 0] = singular[1], singular[:, 1]
    bad = [None, np.zeros((6, 6)), np.full((6, 6), np.nan), singular]
    edges = [PoseEdge(at + 1, 0, rigid(at), each) for at, each in enumerate(bad)]
    assert (
        dcreg.write_pose_graph(
            tmp_path / "a.g2o", [*edges, PoseEdge(9, 0, rigid(9), covariance(9))]
        )
        == edges
    )
    _, found = read(tmp_path / "a.g2o")
    for edge in edges:
        np.testing.assert_array_equal(symmetric(found[0, edge.source][1][7:], 6), np.eye(6))


def test_poses_that_g2o_cannot_hold_are_refused(tmp_path):
    scaled = rigid(0, 2)
    scaled[:2, :2] *= 1.1
    with pytest.raises(dcreg.InputError, match=r"pose of 1 to 0 has scale 1\.1"):
        dcreg.write_pose_graph(tmp_path / "a.g2o", [PoseEdge(1, 0, scaled)])
    with pytest.raises(dcreg.InputError, match="poses of one dimension"):
        dcreg.write_pose_graph(
            tmp_path / "a.g2o", [PoseEdge(1, 0, np.eye(4)), PoseEdge(2, 0, np.eye(3))]
        )
    assert list(tmp_path.iterdir()) == []


def test_a_graph_without_edges_is_empty(tmp_path):
    assert dcreg.write_pose_graph(tmp_path / "a.g2o", []) == []
    assert (tmp_path / "a.g2o").read_text() == ""
