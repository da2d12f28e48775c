"""Benchmark and verification problems as plain data, with their closed forms."""
