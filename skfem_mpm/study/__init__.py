"""The trade between error and cost, measured, for the scenes that ship and for your own; ensembles of random ones."""

from .cheapest import Recommendation, Smaller, cheapest
from .choices import product
from .ensemble import ensemble, generator
from .pareto import pareto
from .problems import PROBLEMS, Problem
from .trade import COSTS, Study, load, tradeoff
from .trend import Trend

__all__ = ["COSTS", "PROBLEMS", "Problem", "Recommendation", "Smaller", "Study", "Trend", "cheapest", "ensemble",
           "generator", "load", "pareto", "product", "tradeoff"]
