"""Spend given hours on the runs that are expected to decide most claims: ``python -m reports evidence``.

Experiments grow by blocks. The next *block* of a claim is one more trial of each of its tests: all levels
and shapes, for the methods that the claim compares. After each block all claims are judged again; their
intervals stay valid under repeated judging. A run is left out (*not needed*) if all claims that would use
it are decided. Which block comes next depends on the results of finished blocks and pilots alone, so a
stopped campaign continues as if it had not been stopped.
"""
