"""Registration methods behind one contract, one folder each; `registry` finds them."""
