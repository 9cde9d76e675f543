"""Damaged and malicious files for every parser: ``python -m tests.fuzz_parsers``."""
