"""The search tree of a cloud is built once and never belongs to other points."""

from dcreg.problem.trees import new_tree, tree_of


def test_a_tree_is_built_once_for_equal_points(rng):
    points = rng.standard_normal((100, 3))
    tree = tree_of(points)
    assert tree_of(points.copy()) is tree
    assert new_tree(points) is not tree


def test_changed_points_get_a_new_tree(rng):
    points = rng.standard_normal((100, 3))
    before = tree_of(points)
    points += 10.0
    distances, _ = tree_of(points).query(points)
    assert tree_of(points) is not before
    assert (distances == 0.0).all()


def test_the_trees_of_two_clouds_stay_and_a_third_displaces_the_older(rng):
    clouds = rng.standard_normal((3, 50, 2))
    first, second = map(tree_of, clouds[:2])
    assert tree_of(clouds[0]) is first
    tree_of(clouds[2])
    assert tree_of(clouds[0]) is first
    assert tree_of(clouds[1]) is not second
