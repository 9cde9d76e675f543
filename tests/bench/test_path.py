"""One call of `register` stays on a short path through the files of the library."""

import pytest
from numba import config

from tests.bench.path import record

# In 2D four files make initial poses, which a search to 1 % of the upper bound needs. A search over a
# space, the alternation of matching and fit, and work in threads (3D only) have a file each. A long
# search asks its cover, which takes two files. Five more are small steps of one file each: weights, the
# costs of pairs, ranges of means, the estimate of memory, and feasible pairs.
MOST_FILES = {"2d": 45, "3d": 47}
MOST_DEPTH = 9


@pytest.mark.skipif(bool(config.DISABLE_JIT), reason="interpreted kernels are files of the path")
@pytest.mark.parametrize("dimension", MOST_FILES)
def test_a_call_enters_few_files(dimension):
    found = record(dimension)
    assert len(found.files) <= MOST_FILES[dimension], list(found.files)
    assert found.depth <= MOST_DEPTH, " > ".join(found.deepest)
