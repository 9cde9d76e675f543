"""Figures that need no network: a page for a registration, a page or an image for a sweep."""

try:
    import plotly  # noqa: F401
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "figures need plotly, which is not installed; install it with: pip install plotly",
        name=error.name,
    ) from None

from dcreg.plot.answer import plot_answer
from dcreg.plot.registration import plot_registration
from dcreg.plot.sweep import plot_sweep

__all__ = ["plot_answer", "plot_registration", "plot_sweep"]
