"""What does accuracy cost in the cylinder, and which choice is the cheapest for an error of 1 %?

The cylinder of section 3 of Gonzalez Acosta, Vardon and Hicks (2017), fifty steps to equilibrium, by the paper's three
methods and by four choices of ours, on two grids each: errors, seconds and memory side by side.  A choice is worth its
price if no other one is both cheaper and better.  Writes, under results/trade_off/ or --out, tradeoff.csv,
tradeoff.json and tradeoff.png; run it again, and what is there is not run again.
"""

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from skfem_mpm import plot, study

CHOICES = [{"method": "mpm"}, {"method": "gimp"}, {"method": "cmpm"}, {"method": "gimp", "weights": "overlap"},
           {"method": "gc", "domains": "stretched"}, {"method": "mpm", "integration": "dual"},
           {"method": "mpm", "integration": "cubic"}]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="10 steps, one timed run each, no memory")
    parser.add_argument("--out", type=Path, default=Path("results/trade_off"), help="where picture and tables go")
    options = parser.parse_args()
    steps, repeats = (10, 1) if options.quick else (50, 3)

    found = study.tradeoff("cylinder", cells=[10, 20], choices=CHOICES, steps=[steps], repeats=repeats,
                           memory=not options.quick, out=options.out)
    print(f"rms error of q over all points after {steps} steps; * marks what no other choice beats")
    print(found.table("all"))
    plot.trade(found, "all").savefig(options.out / "tradeoff.png", dpi=130)

    within = [row for row in found.front("all") if row["error_all"] <= 0.01]
    best = within[0]
    print(f"the cheapest within 1 %: {found.label(best)} with {best['cells']} cells, error "
          f"{100 * best['error_all']:.2g} % in {best['wall_s']:.2g} s")
    print(f"Pictures and tables are in {options.out}.")


if __name__ == "__main__":              # memory is measured in processes of their own, which read this file again
    main()
