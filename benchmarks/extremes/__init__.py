"""The extremes of the stability map, a family of rows a file; see ``benchmarks/stability_map.py``."""
