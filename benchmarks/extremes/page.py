"""The stability map as text and as the page docs/stability.md."""

import math
import textwrap

from extremes.row import METHODS, REMEDIES

SQUARE = {"holds": "🟩", "degrades": "🟨", "stops": "🟦", "wrong": "🟥", "": ""}


def number(value):
    """Two digits."""
    if value == math.inf:
        return "∞"
    if value is None or value == 0 or 0.01 <= abs(value) < 1000:
        return "" if value is None else f"{float(f'{value:.2g}'):g}"
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{mantissa.removesuffix('.0')}e{int(exponent)}"


def entry(cell):
    """A cell as tables show it."""
    if not cell or not cell["verdict"]:
        return "–"
    what = "stops" if cell["verdict"] == "stops" else number(cell["value"])
    return f"{SQUARE[cell['verdict']]} {what}{' ⚠' if cell['warnings'] and cell['verdict'] != 'stops' else ''}"


def as_text(found):
    """A line a row, to be printed."""
    lines = []
    for row, cells in found.items():
        lines.append(row)
        lines += [f"    {key:28} {cell['verdict']:9} {number(cell['value']):8} {cell['message'][:150]}"
                  for key, cell in cells.items()]
    return "\n".join(lines)


def markdown(rows):
    head, *rest = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([head, f"|{'---|' * len(rows[0])}", *rest])


def family_table(family, cells):
    rows = [["", *(f"`{name}`" for name in METHODS)]]
    rows += [[row.name, *(entry(cells.get(row.name, {}).get(name)) for name in METHODS)] for row in family.ROWS]
    return markdown(rows)


def sentence(row, cells):
    """What a row is about, its limits, and with which words runs stop there."""
    words = " ".join(row.says.split())
    words += f" Holds up to {number(row.holds)}"
    words += f", wrong beyond {number(row.useless)}." if row.holds < row.useless < math.inf else "."
    stops = [(key, cell["message"]) for key, cell in cells.get(row.name, {}).items() if cell["verdict"] == "stops"]
    if stops:
        remedied = sum("," in key for key, _ in stops)
        among = f" ({remedied} with a remedy)" * bool(remedied)
        words += (f" Stops in {len(stops)} cell{'s' * (len(stops) > 1)}{among}, `{stops[0][0]}` with: "
                  f"“{first_words(stops[0][1])}”")
    return "\n".join(textwrap.wrap(f"- **{row.name}.** {words}", 120, subsequent_indent="  ",
                                   break_long_words=False, break_on_hyphens=False))


def first_words(message):
    """A message of a stop, cut off where it is long."""
    return message if len(message) < 200 else message[:200].rsplit(" ", 1)[0] + " …"


def remedy_table(name, families, cells):
    """Before and after, for the rows in which a remedy was tried."""
    rows = [["", *(f"`{method}`" for method in METHODS)]]
    for row in (row for family in families for row in family.ROWS if name in row.remedies):
        of_row = cells.get(row.name, {})
        line = []
        for method in METHODS:
            before, after = entry(of_row.get(method)), entry(of_row.get(f"{method}, {name}"))
            line.append("–" if after == "–" else f"{before} → {after}")
        rows.append([row.name, *line])
    return markdown(rows) if len(rows) > 1 else ""


def chosen(name):
    """The arguments of a remedy, as one writes them."""
    return ", ".join(f"{key}={value!r}".replace("'", '"') for key, value in REMEDIES[name].items())


HEAD = """# Where each method holds, and where it breaks

Made by `python benchmarks/stability_map.py --write`{about}; do not
edit. Anybody can measure it anew: without `--write` the script compares, and exits with 1 if a cell is worse than here;
`--quick` does so in two minutes, without remedies.

Each row is an extreme, each cell what was measured there.

- 🟩 **holds**: within the limit that the row states.
- 🟨 **degrades**: beyond that limit and still of use; or worse, and the run said so.
- 🟦 **stops**: the run ended with an error that says where, why and what to do, and keeps its last good state; or the
  set-up was refused before the first step.
- 🟥 **wrong**: an answer of no use, given without a word. There {wrong} such cell{s}.
- ⚠: the run warned of it. –: the question makes no sense there.

Numbers are what the row's sentence says is measured; smaller is better.
"""


def page_of(families, stored):
    """The page, from the committed map."""
    families, cells, about = list(families), stored.get("full", {}), stored.get("about", {}).get("full")
    where = "\non {date} ({machine}, {cores} cores, {minutes} minutes)".format(**about) if about else ""
    wrong = sum(cell["verdict"] == "wrong" for of_row in cells.values() for cell in of_row.values())
    parts = [HEAD.format(about=where, wrong=f"are {wrong}" if wrong > 1 else "is one" if wrong else "is no",
                         s="s" * (wrong > 1))]
    for family in families:
        parts += [f"## {family.TITLE}\n", family.WORDS.strip() + "\n", family_table(family, cells) + "\n",
                  "\n".join(sentence(row, cells) for row in family.ROWS) + "\n"]
    parts.append("## What remedies do: before → after\n")
    for name in REMEDIES:
        table = remedy_table(name, families, cells) if name else ""
        if table:
            parts += [f"### {name}: `{chosen(name)}`\n", table + "\n"]
    return "\n".join(parts).rstrip() + "\n"
