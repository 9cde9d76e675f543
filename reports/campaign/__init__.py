"""Spend given hours on the runs that decide claims soonest: ``python -m reports evidence``.

Experiments grow by blocks. A *block* is one more trial of each test of one comparison, at the levels that
it compares, on all shapes. After each step (a pilot, or one or more blocks) all claims are judged again;
their intervals stay valid under repeated judging. A run that is in no block so far is counted as *not
needed*. Which step comes next depends on the results of finished steps alone, so a
stopped campaign continues as if it had not been stopped.
"""
