"""Checks how the pages are written: sentences, lines, dates and seeds, words to avoid. python
docs/prose.py
"""

import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]
RESULTS = {
    "results.md",
    "completion.md",
    "street.md",
    "densify.md",
    "labels.md",
    "which_system.md",
    "CHANGELOG.md",
}  # where measurements belong
# of a sentence; characters of a row of a table and of another line
WORDS, TABLE, LINE = 30, 120, 200
DATE = re.compile(r"\b20\d\d-\d\d-\d\d\b|\bseeds? \d")
AVOID = re.compile(
    r"\b(twin|goes on|go on|mended|knows nothing|has no [a-z]+ of its own|of which nothing|is "
    r"none|are none)\b",
    re.I,
)


def faults(text: str, measured: bool) -> Iterator[tuple[int, str]]:
    """Line numbers and what is wrong there."""
    code = False
    for number, line in enumerate(text.splitlines(), start=1):
        if line.lstrip().startswith("```"):
            code = not code
        if code or line.lstrip().startswith(("```", "    ", "<!--")):
            continue
        shown = re.sub(r"\]\([^)]*\)|\{py:\w+\}|[`*|\[]", "", line).strip()  # as a reader sees it
        plain = re.sub(r"`[^`]*`", "code", re.sub(r"\]\([^)]*\)", "]", line))
        table = line.startswith("|")
        if len(shown) > (TABLE if table else LINE):
            yield number, f"{len(shown)} characters"
        if not measured and (found := DATE.search(plain)):
            yield number, f"'{found[0]}' belongs into results"
        if found := AVOID.search(plain):
            yield number, f"'{found[0]}'"
        for sentence in re.split(r"(?<=[.!?:;])\s+|\|", plain):
            words = re.findall(r"[\w'’-]+", sentence)
            if len(words) > WORDS:
                yield number, f"a sentence of {len(words)} words: {' '.join(words[:6])} ..."


def main() -> int:
    """The number of faults."""
    count = 0
    for page in PAGES:
        for number, fault in faults(page.read_text(encoding="utf-8"), page.name in RESULTS):
            print(f"{page.relative_to(ROOT)}:{number}: {fault}")
            count += 1
    return count


if __name__ == "__main__":
    sys.exit(min(main(), 1))
