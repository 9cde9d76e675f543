"""Mode ``paper`` in 2D."""

from dcreg.families.mode import Mode
from dcreg.families.similarity2d.space import Similarity2D

MODE = Mode(
    "searches the similarity as the paper does; certifies the pose",
    Similarity2D,
    needs=("scale_range",),
    certifies="similarity2d",
)
