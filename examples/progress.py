"""Watch a search and stop it: a listener receives every event and stops the search by returning True."""

import numpy as np

import dcreg

rng = np.random.default_rng(5)
source = rng.random((30, 2))
target = rng.random((30, 2))  # unrelated, so the bounds take long to meet


def listener(event: dcreg.Event) -> bool:
    print(f"{event.time_s:6.2f} s  {event.kind:5}  {event.n_nodes:6d} boxes  "
          f"{event.lower_bound:.4f} .. {event.upper_bound:.4f}")  # fmt: skip
    return event.n_nodes > 2000  # stop


result = dcreg.register(
    source,
    target,
    n_inliers=20,
    model="similarity2d",
    rel_gap=1e-6,
    options=dcreg.SolveOptions(listener=listener),
)
print(result.status, "with valid bounds:", result.lower_bound, "<=", result.upper_bound)

assert result.status == "stopped"
assert result.lower_bound <= result.upper_bound
assert len(result.trace) > 0  # the same events
