"""The problem library: problems, records, and the checks of both."""

from data.library.problem import LibraryError, Problem, all_problems, find_problem
from data.library.record import Record, read_record

__all__ = ["LibraryError", "Problem", "Record", "all_problems", "find_problem", "read_record"]
