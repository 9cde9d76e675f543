"""Fetching, cards, sampling and the loaders' particulars."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import os
import pickle
import shutil
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import grimp
import numpy as np
import pytest
import yaml
from scipy.spatial import cKDTree

from data import fetch as fetching
from data.chui_rangarajan.loader import Loader as ChuiRangarajan
from data.chui_rangarajan.loader import _checksums
from data.contract import DataError, File, UnknownNameError
from data.fetch import ChecksumError, SizeError, UnavailableError, cache_path, fetch
from data.registry import dataset, read_card
from data.sampling import farthest_points, mutual_nearest, normalise, voxel_downsample
from data.threedmatch import loader as threedmatch
from data.threedmatch.select_pairs import official, select
from dcreg.problem import apply_pose
from workflows.stages import generate

NOWHERE = "http://127.0.0.1:9/none"  # refuses connections at once
MIRROR = os.environ.get("DCREG_DATA_MIRROR", "")
needs_mirror = pytest.mark.skipif(
    not Path(MIRROR).is_dir() or not MIRROR,
    reason="DCREG_DATA_MIRROR names no folder: the public files are not here",
)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("DCREG_DATA_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def no_mirror(monkeypatch):
    monkeypatch.delenv("DCREG_DATA_MIRROR", raising=False)


CONTENT = b"1 2\n3 4\n"


def file_of(content=CONTENT, url=NOWHERE, path="2d/set/points.txt", **kwargs):
    sha256 = hashlib.sha256(content).hexdigest()
    return File(dataset="a_set", path=path, url=url, **{"sha256": sha256, **kwargs})


def put(root, content=CONTENT, path="2d/set/points.txt"):
    (root / path).parent.mkdir(parents=True, exist_ok=True)
    (root / path).write_bytes(content)
    return root


# --- fetch -------------------------------------------------------------------------------------


def test_mirror_folder_then_cache(tmp_path, cache, monkeypatch):
    mirror = put(tmp_path / "mirror")
    monkeypatch.setenv("DCREG_DATA_MIRROR", str(mirror))
    path = fetch(file_of())
    assert path == cache / "a_set/2d/set/points.txt"
    assert path.read_bytes() == CONTENT
    shutil.rmtree(mirror / "2d")
    assert fetch(file_of()) == path  # now from the cache alone


def test_mirror_address_and_origin(tmp_path, serve, monkeypatch, no_mirror):
    address, asked = serve(put(tmp_path / "web"))
    assert fetch(file_of(url=f"{address}/2d/set/points.txt")).read_bytes() == CONTENT
    cache_path(file_of()).unlink()
    monkeypatch.setenv("DCREG_DATA_MIRROR", address + "/")
    assert fetch(file_of()).read_bytes() == CONTENT
    assert asked == ["/2d/set/points.txt"] * 2


def test_origin_when_the_mirror_lacks_the_file(tmp_path, serve, monkeypatch):
    address, _ = serve(put(tmp_path / "web"))
    for empty in (str(tmp_path), f"{address}/nothing"):
        monkeypatch.setenv("DCREG_DATA_MIRROR", empty)
        assert fetch(file_of(url=f"{address}/2d/set/points.txt")).read_bytes() == CONTENT
        cache_path(file_of()).unlink()


@pytest.mark.parametrize("where", ["mirror folder", "mirror address", "origin"])
def test_wrong_checksum_is_an_error_and_not_kept(where, tmp_path, serve, monkeypatch, no_mirror):
    root = put(tmp_path / "root", b"something else")
    address, _ = serve(root)
    url = f"{address}/2d/set/points.txt" if where == "origin" else NOWHERE
    if where.startswith("mirror"):
        monkeypatch.setenv("DCREG_DATA_MIRROR", str(root) if "folder" in where else address)
    with pytest.raises(ChecksumError) as caught:
        fetch(file_of(url=url))
    message = str(caught.value)
    for part in ("points.txt", file_of().sha256, "expected", "found", "Remedy"):
        assert part in message
    assert hashlib.sha256(b"something else").hexdigest() in message
    assert list(cache_path(file_of()).parent.iterdir()) == []


@pytest.mark.parametrize("where", ["mirror folder", "mirror address", "origin"])
@pytest.mark.parametrize("size", [len(CONTENT), None])
def test_a_file_that_is_too_large_is_not_fetched(
    where, size, tmp_path, serve, monkeypatch, no_mirror
):
    """Without a size on the card, a general limit holds."""
    monkeypatch.setattr(fetching, "MOST_BYTES", len(CONTENT))
    root = put(tmp_path / "root", CONTENT + bytes(100_000))
    address, _ = serve(root)
    url = f"{address}/2d/set/points.txt" if where == "origin" else NOWHERE
    if where.startswith("mirror"):
        monkeypatch.setenv("DCREG_DATA_MIRROR", str(root) if "folder" in where else address)
    with pytest.raises(SizeError, match=rf"more than {len(CONTENT)} bytes.*; not kept\nRemedy"):
        fetch(file_of(url=url, size=size))
    folder = cache_path(file_of()).parent
    assert not folder.exists() or list(folder.iterdir()) == []


def test_an_endless_answer_is_cut_off(tmp_path, no_mirror):
    """The server states no length and never stops by itself."""
    sent = []

    class Endless(SimpleHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.end_headers()
            with contextlib.suppress(OSError):
                while len(sent) < 10_000:
                    self.wfile.write(bytes(100_000))
                    sent.append(1)

        def log_message(self, *arguments):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Endless) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with pytest.raises(SizeError):
            fetch(file_of(url=f"http://127.0.0.1:{server.server_port}/x", size=10))
        server.shutdown()
    assert len(sent) < 1000


def test_a_damaged_cache_is_replaced(tmp_path, monkeypatch):
    monkeypatch.setenv("DCREG_DATA_MIRROR", str(put(tmp_path / "mirror")))
    path = fetch(file_of())
    path.write_bytes(CONTENT[:3])
    assert fetch(file_of()).read_bytes() == CONTENT


def test_offline_error_names_address_and_place(cache, no_mirror):
    with pytest.raises(UnavailableError) as caught:
        fetch(file_of())
    assert NOWHERE in str(caught.value)
    assert str(cache / "a_set/2d/set/points.txt") in str(caught.value)
    assert "DCREG_DATA_MIRROR" in str(caught.value)


def test_a_file_put_by_hand_is_used_and_a_wrong_one_is_named(cache, no_mirror):
    put(cache / "a_set")
    assert fetch(file_of()).read_bytes() == CONTENT
    put(cache / "a_set", b"wrong")
    with pytest.raises(UnavailableError, match="its checksum is"):
        fetch(file_of())


def test_a_mirror_that_is_no_folder_is_an_error(monkeypatch):
    monkeypatch.setenv("DCREG_DATA_MIRROR", "/no/such/folder")
    with pytest.raises(DataError, match="DCREG_DATA_MIRROR=/no/such/folder is not a folder"):
        fetch(file_of())


def test_git_blob_ids_are_understood(tmp_path, monkeypatch):
    monkeypatch.setenv("DCREG_DATA_MIRROR", str(put(tmp_path / "mirror", b"hello\n")))
    # What `git hash-object` says of a file with the line hello.
    file = file_of(sha256=None, git_sha1="ce013625030ba8dba906f756967f9e9ca394464a")
    assert fetch(file).read_bytes() == b"hello\n"
    with pytest.raises(UnavailableError):
        fetching.fetch(file.model_copy(update={"path": "2d/other.txt"}))


def test_alternatives_serve_when_the_first_has_no_source(tmp_path, serve, no_mirror):
    address, asked = serve(put(tmp_path / "web"))
    pack = file_of(b"the pack", url=None, path="2d/pack.npz")
    original = file_of(url=f"{address}/2d/set/points.txt")
    assert fetch(pack, original) == cache_path(original)
    assert fetch(pack, original) == cache_path(original)  # the cache holds the alternative
    assert len(asked) == 1


# --- cards -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"colour": "red"}, "colour"),
        ({"dim": 4}, "dim"),
        ({"name": "other"}, "differs from its folder"),
        ({"files": [{"path": "a"}]}, "exactly one of sha256 and git_sha1"),
        ({"files": [{"path": "../a", "sha256": "0" * 64}]}, "not allowed"),
        ({"files": [{"path": "/etc/a", "sha256": "0" * 64}]}, "path"),
        ({"files": [{"path": "a\0b", "sha256": "0" * 64}]}, "path"),
        ({"files": [{"path": "a", "sha256": "0" * 64, "dataset": "../b"}]}, "dataset"),
        ({"files": [{"path": "a", "url": "file:///etc/passwd", "sha256": "0" * 64}]}, "url"),
        ({"files": [{"path": "a", "sha256": "xyz"}]}, "sha256"),
    ],
)
def test_bad_cards_are_refused(tmp_path, wrong, message):
    good = {
        "name": "a",
        "title": "t",
        "dim": 2,
        "licence": "l",
        "citation": "c",
        "loader": "points",
    }
    card = tmp_path / "a" / "card.yaml"
    card.parent.mkdir()
    card.write_text(yaml.safe_dump(good))
    assert read_card(card).name == "a"
    card.write_text(yaml.safe_dump({**good, **wrong}))
    with pytest.raises(DataError, match=message):
        read_card(card)


def test_unknown_names_are_refused_with_a_suggestion():
    with pytest.raises(UnknownNameError, match="did you mean 'saurian'"):
        dataset("embedded").prototype("saurain")
    with pytest.raises(UnknownNameError, match="level of test noise 7"):
        dataset("chui_rangarajan").instance("fish", "noise", 7, 0)
    with pytest.raises(UnknownNameError, match=r"trial of test def 100; known: 0\.\.99"):
        dataset("chui_rangarajan").instance("fish", "def", 1, 100)
    with pytest.raises(UnknownNameError, match="did you mean 'embedded'"):
        dataset("embeded")


# --- sampling ----------------------------------------------------------------------------------


def test_farthest_points_cover_a_grid():
    grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), axis=-1).reshape(-1, 2)
    corners = grid[farthest_points(grid, 4)]
    assert {tuple(corner) for corner in corners} == {(0, 0), (0, 4), (4, 0), (4, 4)}
    assert sorted(farthest_points(grid, 25)) == list(range(25))
    with pytest.raises(ValueError, match="n=26 exceeds the 25 points"):
        farthest_points(grid, 26)


def test_voxels_hold_means():
    points = np.array([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [-0.1, 0.1, 0.1]])
    coarse = voxel_downsample(points, 0.5)
    np.testing.assert_allclose(sorted(coarse.tolist()), [[-0.1, 0.1, 0.1], [0.2, 0.1, 0.1]])


def test_mutual_nearest_is_one_to_one_and_within_tolerance():
    rng = np.random.default_rng(0)
    a, b = rng.random((60, 3)), rng.random((50, 3))
    pairs = mutual_nearest(a, b, 0.2)
    distance = np.linalg.norm(a[:, None] - b[None], axis=-1)
    expected = [
        (i, j)
        for i in range(60)
        for j in range(50)
        if distance[i].argmin() == j and distance[:, j].argmin() == i and distance[i, j] <= 0.2
    ]
    assert pairs.tolist() == [list(pair) for pair in expected]
    assert len(expected) > 5


# --- embedded shapes ---------------------------------------------------------------------------


@pytest.mark.parametrize("shape", ["fish", "glyph", "pony", "saurian"])
@pytest.mark.parametrize("n_points", [None, 31, 100, 400])
def test_embedded_shapes_have_any_number_of_distinct_points(shape, n_points):
    points = dataset("embedded").prototype(shape, n_points)
    assert len(points) == (n_points or 100)
    nearest = cKDTree(points).query(points, k=2)[0][:, 1]
    assert nearest.min() > 0.02 * np.median(nearest)


@pytest.mark.parametrize("shape", ["pony", "saurian"])
def test_solids_are_not_their_own_mirror_image(shape):
    """Else norm space has two optima, of which only one admits a proper rotation."""
    points = dataset("embedded").prototype(shape, 400)
    spacing = np.median(cKDTree(points).query(points, k=2)[0][:, 1])
    mirrored = points * [1, -1, 1]  # the animal's own left and right
    for _ in range(30):  # ICP gives the reflection its best chance
        nearest = points[cKDTree(points).query(mirrored)[1]]
        x, y = mirrored - mirrored.mean(axis=0), nearest - nearest.mean(axis=0)
        U, _, Vt = np.linalg.svd(y.T @ x)
        R = (U * [1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt
        mirrored = x @ R.T + nearest.mean(axis=0)
    distance = cKDTree(points).query(mirrored)[0]
    # a symmetric pony has 0.5, these have 1.2 and 1.5
    assert np.sqrt((distance**2).mean()) > spacing


def with_originals(loader, name, address):
    """A data set that takes its original files from `address`."""
    card = dataset(name).card
    parameters = {**card.parameters, "originals": address}
    return loader(card.model_copy(update={"parameters": parameters}))


# --- Chui and Rangarajan -----------------------------------------------------------------------

CHUI = [
    (s, t) for s in ("fish", "character") for t in ("def", "noise", "outlier", "rot", "occlusion")
]


@needs_mirror
@pytest.mark.parametrize(("shape", "test"), CHUI)
def test_pack_and_original_give_the_same_instance(shape, test, serve, monkeypatch):
    packed = dataset("chui_rangarajan").instance(shape, test, 3, 0)
    address, asked = serve(Path(MIRROR) / "2d/chui-rangarajan/raw")
    monkeypatch.delenv("DCREG_DATA_MIRROR")
    monkeypatch.setenv("DCREG_DATA_CACHE", os.environ["DCREG_DATA_CACHE"] + "_2")
    single = _official_chui(address).instance(shape, test, 3, 0)
    assert len(asked) == 1  # one sample, one file
    assert asked[0].endswith("_3_1.mat")
    for name in ("source", "target", "pairs", "T_true"):
        np.testing.assert_array_equal(getattr(packed, name), getattr(single, name))


def _official_chui(address):
    return with_originals(ChuiRangarajan, "chui_rangarajan", address)


def test_chui_offline_names_the_single_original(no_mirror, monkeypatch):
    with pytest.raises(UnavailableError, match=r"save_chinese_rot_2_8\.mat"):
        _official_chui(NOWHERE).instance("character", "rot", 2, 7)


@needs_mirror
@pytest.mark.parametrize(("shape", "test"), CHUI)
def test_checksum_table_is_that_of_the_originals(shape, test):
    stem = f"{'chinese' if shape == 'character' else shape}_{test}"
    with np.load(Path(MIRROR) / f"2d/chui-rangarajan/{stem}.npz") as pack:
        blob_ids = pack["git_blob_sha1"]
    table = _checksums()[stem]
    assert [[bytes(cell).hex() for cell in row] for row in table] == blob_ids.tolist()


def _residual(instance):
    i, j = instance.pairs.T
    left = apply_pose(instance.T_true, instance.source[i]) - instance.target[j]
    return np.sqrt((left**2).sum(axis=1).mean())


@needs_mirror
@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ("fish", [0.025, 0.046, 0.068, 0.084, 0.109]),
        ("character", [0.028, 0.054, 0.083, 0.106, 0.129]),
    ],
)
def test_chui_deformation_residuals(shape, expected):
    chui = dataset("chui_rangarajan")
    for level, value in enumerate(expected, start=1):
        left = [_residual(chui.instance(shape, "def", level, trial)) for trial in range(100)]
        assert np.mean(left) == pytest.approx(value, abs=0.0015)


@needs_mirror
@pytest.mark.parametrize(("shape", "n"), [("fish", 98), ("character", 105)])
def test_chui_sizes(shape, n):
    chui = dataset("chui_rangarajan")
    tests = chui.tests()
    for level, ratio in zip(tests["outlier"].levels, tests["outlier"].values, strict=True):
        made = chui.instance(shape, "outlier", level, 5)
        assert (len(made.source), len(made.pairs)) == (n, n)
        assert len(made.target) == int(n * (1 + ratio))
    for level, share in zip(tests["occlusion"].levels, tests["occlusion"].values, strict=True):
        made = chui.instance(shape, "occlusion", level, 5)
        assert len(made.source) == n
        assert len(made.target) == len(made.pairs) == pytest.approx(n * (1 - share), abs=1)


@needs_mirror
def test_chui_prototypes_agree_with_lian():
    fish = dataset("chui_rangarajan").instance("fish", "def", 1, 0).source
    np.testing.assert_allclose(normalise(fish), dataset("lian_apm").prototype("fish"), atol=1e-12)


# --- 3DMatch -----------------------------------------------------------------------------------


def in_torch_format(array):
    stream = io.BytesIO()
    for item in (119547037146038801333356, 1001, {"little_endian": True}, array):
        pickle.dump(item, stream, protocol=2)
    return stream.getvalue()


def test_pickles_may_not_run_code(tmp_path):
    class Evil:
        def __reduce__(self):
            return os.getcwd, ()

    path = tmp_path / "cloud.pth"
    path.write_bytes(in_torch_format(Evil()))
    with pytest.raises(DataError, match="differs from the official one"):
        threedmatch.read_torch_array(path)


@needs_mirror
@pytest.mark.parametrize("number", [21, 34])
def test_fragment_pack_and_original_give_the_same_points(number, serve, monkeypatch, tmp_path):
    """The mirror holds these two originals; neither is in the frozen list, hence the table here."""
    scene = "7-scenes-redkitchen"
    raw = Path(MIRROR) / f"3dmatch/raw/predator-redkitchen/cloud_bin_{number}.pth"
    row = {"scene": scene, "fragment": str(number), "size": str(raw.stat().st_size)}
    row["sha256"] = hashlib.sha256(raw.read_bytes()).hexdigest()
    monkeypatch.setattr(threedmatch, "read_csv", lambda name: [row])
    clouds = dataset("threedmatch")
    packed = threedmatch.fragment(clouds.fetch_fragment(scene, number), number)

    web = tmp_path / "web" / scene
    web.mkdir(parents=True)
    shutil.copyfile(raw, web / raw.name)
    address, asked = serve(tmp_path / "web")
    monkeypatch.delenv("DCREG_DATA_MIRROR")
    monkeypatch.setenv("DCREG_DATA_CACHE", str(tmp_path / "second"))
    official = with_originals(threedmatch.Loader, "threedmatch", address)
    path = official.fetch_fragment(scene, number)
    assert path.suffix == ".pth"
    assert len(asked) == 1
    np.testing.assert_array_equal(threedmatch.fragment(path, number), packed)
    np.testing.assert_array_equal(threedmatch.read_torch_array(path), packed)  # float32 is lossless


@needs_mirror
@pytest.mark.parametrize(
    ("table", "names", "rule", "n_rows"),
    [
        ("pairs.csv", ("3DMatch", "3DLoMatch"), select, 40),
        ("lists.csv", threedmatch.LISTS, official, 1623 + 1781),
    ],
)
def test_frozen_tables_follow_their_rule(table, names, rule, n_rows):
    card = dataset("threedmatch").card
    files = {name: fetch(card.file(f"3dmatch/meta/{name}.pkl")) for name in names}
    rows = rule({name: threedmatch.read_metadata(file) for name, file in files.items()})
    chosen = [{key: str(value) for key, value in row.items()} for row in rows]
    assert chosen == threedmatch.read_csv(table)
    assert len(chosen) == n_rows


@needs_mirror
def test_official_pair_comes_whole_with_the_protocols_threshold():
    made = dataset("threedmatch").instance("7-scenes-redkitchen", "3DMatch", 0.4, 0)
    assert min(len(made.source), len(made.target)) > 4000
    assert made.noise_bound == 0.1
    assert made.match_radii == (0.1, 0.25)
    assert made.viewpoint is None
    oriented = dataset("threedmatch").instance("7-scenes-redkitchen", "3DMatch-oriented", 0.4, 0)
    assert oriented.viewpoint == (0.0, 0.0, 0.0)
    np.testing.assert_array_equal(oriented.source, made.source)
    for cloud in (made.source, made.target):  # all that the sensor saw lies before it
        assert (cloud[:, 2] > oriented.viewpoint[2]).all()
    i, j = made.pairs.T
    distance = np.linalg.norm(apply_pose(made.T_true, made.source[i]) - made.target[j], axis=1)
    assert distance.max() <= 0.1
    with pytest.raises(DataError, match="3DMatch uses whole clouds; remove n_points"):
        dataset("threedmatch").instance("7-scenes-redkitchen", "3DMatch", 0.4, 0, 100)


@needs_mirror
def test_every_fragment_of_the_frozen_lists_has_its_checksum():
    with open(Path(MIRROR) / "3dmatch/fragments/MANIFEST.csv", newline="") as stream:
        known = {(r["scene"], r["fragment"]): r["original_sha256"] for r in csv.DictReader(stream)}
    listed = {
        (r["scene"], r["fragment"]): r["sha256"] for r in threedmatch.read_csv("fragments.csv")
    }
    needed = {
        (row["scene"], row[side])
        for table in ("pairs.csv", "lists.csv")
        for row in threedmatch.read_csv(table)
        for side in ("ref_i", "src_j")
    }
    assert set(listed) == needed
    assert all(known[key] == value for key, value in listed.items())


@needs_mirror
@pytest.mark.parametrize("level", [0.25, 0.75])
def test_official_pose_brings_the_scans_together(level):
    made = dataset("threedmatch").instance("7-scenes-redkitchen", "overlap", level, 0, 200)
    assert len(made.source) == len(made.target) == 200
    i, j = made.pairs.T
    distance = np.linalg.norm(apply_pose(made.T_true, made.source[i]) - made.target[j], axis=1)
    assert distance.max() <= 0.15
    inverse = mutual_nearest(apply_pose(np.linalg.inv(made.T_true), made.source), made.target, 0.15)
    assert len(made.pairs) > 2 * len(inverse)  # the direction is source to target
    np.testing.assert_allclose(made.T_true[:3, :3] @ made.T_true[:3, :3].T, np.eye(3), atol=1e-12)


def test_what_makes_an_instance_is_in_its_digest(monkeypatch):
    """All modules that loaders import, except the fetching: fetched files have checksums."""
    counted = []
    monkeypatch.setattr(
        generate,
        "digest_paths",
        lambda paths, root: counted.extend(path.relative_to(root).as_posix() for path in paths),
    )
    generate.sources_digest([])
    imports = grimp.build_graph("data", cache_dir=None)
    imports.remove_module("data.fetch")
    needed = {name for name in imports.modules if name.endswith(("loader", "loaders"))}
    needed |= {name for loader in needed for name in imports.find_upstream_modules(loader)}
    shared = {f"{name.replace('.', '/')}.py" for name in needed if name.count(".") == 1}
    assert shared <= set(counted)
    assert len(shared) > 3
