"""How the lines of figures and tables are called."""

import pytest

from workflows.config import MethodSettings
from workflows.stages.aggregate import display_name


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"baseline": "icp"}, "ICP (trimmed, multi-start)"),
        ({"baseline": "icp", "label": "ICP, mine"}, "ICP, mine"),
        ({"baseline": "icp", "n_inliers_ratio": 0.5}, "ICP (trimmed, multi-start) (n_p × 0.5)"),
        ({"baseline": "rpm_pa"}, "RPM-PA (reconstructed)"),
        ({"baseline": "rpm_pa", "label": "RPM-PA exact"}, "RPM-PA exact (reconstructed)"),
        ({"baseline": "rpm_pa", "label": "Reconstructed PA"}, "Reconstructed PA"),
    ],
)
def test_no_label_hides_a_reconstruction(settings, expected):
    assert display_name(MethodSettings(name="line", **settings)) == expected
