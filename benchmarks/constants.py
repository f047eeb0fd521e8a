"""How many numbers tracking rests on: those with names, and literals other than 0, 1, 2 and 0.5.

python benchmarks/constants.py  # a table of the files
"""

import ast
from pathlib import Path

TRACKING = "reconstruct/tracking"
CALLED = (  # by it, for this purpose
    "reconstruct/evaluation/paired.py",
    "reconstruct/geometry/cloud.py",
    "reconstruct/geometry/seen.py",
    "reconstruct/sampling/clean_plate.py",
)
PLAIN = (0, 1, 2, 0.5)


def named_and_literals(source: str) -> tuple[int, int]:
    """Numbers to which a file gives names, of a tuple each one, and those that stand elsewhere in it."""
    named = literals = 0
    for node in ast.parse(source).body:
        parts = list(ast.walk(node))
        constants = (n.value for n in parts if isinstance(n, ast.Constant))
        numbers = [c for c in constants if isinstance(c, int | float) and not isinstance(c, bool)]
        computed = any(isinstance(n, ast.Call) for n in parts)
        if isinstance(node, ast.Assign | ast.AnnAssign) and not computed:
            named += len(numbers)
        else:
            literals += sum(number not in PLAIN for number in numbers)
    return named, literals


def main() -> None:
    """Print a row a file, and their sums."""
    root = Path(__file__).resolve().parent.parent
    paths = [*sorted((root / TRACKING).rglob("*.py")), *(root / name for name in CALLED)]
    counted = {path.relative_to(root).as_posix(): named_and_literals(path.read_text()) for path in paths}
    counted["all"] = tuple(map(sum, zip(*counted.values(), strict=True)))
    print(f"{'file':<52}{'named':>8}{'literals':>10}")
    for name, (named, literals) in counted.items():
        if named or literals:
            print(f"{name:<52}{named:>8}{literals:>10}")


if __name__ == "__main__":
    main()
