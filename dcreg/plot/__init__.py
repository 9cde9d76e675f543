"""Figures without a network: a page per registration, and a sweep's curves as a page or an image."""

try:
    import plotly  # noqa: F401
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "figures need plotly, which is missing here; install it with: pip install plotly",
        name=error.name,
    ) from None

from dcreg.plot.registration import plot_registration
from dcreg.plot.sweep import plot_sweep

__all__ = ["plot_registration", "plot_sweep"]
