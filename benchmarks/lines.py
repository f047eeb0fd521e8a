"""How much there is to keep in step: lines of Python, and of these code (no blanks, comments, docstrings).

python benchmarks/lines.py            # a table of the folders
python benchmarks/lines.py FOLDER ..  # of these only
"""

import ast
import io
import sys
import tokenize
from pathlib import Path

PRODUCT = ("capture", "calibration", "flow", "reconstruct", "pipelines", "lab", "src", "benchmarks")
NOT_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}


def lines_and_code(source: str) -> tuple[int, int]:
    """Lines of a file, and those that hold code."""
    docstrings: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0] if node.body else None
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                if isinstance(first.value.value, str):
                    docstrings |= set(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    code: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in NOT_CODE:
            code |= set(range(token.start[0], token.end[0] + 1))
    return source.count("\n"), len(code - docstrings)


def of_folder(folder: Path) -> tuple[int, int]:
    """Lines and lines of code of all Python files below a folder."""
    counted = [lines_and_code(f.read_text(encoding="utf-8")) for f in sorted(folder.rglob("*.py"))]
    return sum(a for a, _ in counted), sum(b for _, b in counted)


def main(folders: list[str]) -> None:
    """Print a row a folder and the sums of the product (with benchmarks) and the tests."""
    root = Path(__file__).resolve().parent.parent
    print(f"{'folder':<24}{'lines':>8}{'code':>8}")
    if folders:
        for name in folders:
            print(f"{name:<24}{of_folder(Path(name))[0]:>8}{of_folder(Path(name))[1]:>8}")
        return
    counted = {name: of_folder(root / name) for name in (*PRODUCT, "tests")}
    counted["product, benchmarks"] = tuple(sum(counted[name][i] for name in PRODUCT) for i in (0, 1))
    for name, (lines, code) in counted.items():
        print(f"{name:<24}{lines:>8}{code:>8}")


if __name__ == "__main__":
    main(sys.argv[1:])
