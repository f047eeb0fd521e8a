"""What the program says has gone wrong: each code with its texts, as tests/messages.json keeps them.

A text may be put in other words, but programs read the code. `python tests/test_messages.py` writes the file anew.
"""

import ast
import json
import re
from pathlib import Path

KEPT = Path(__file__).with_name("messages.json")
ROOMS = ("capture", "calibration", "flow", "reconstruct", "pipelines", "lab", "src")
FORM = re.compile(r"[a-z]+(-[a-z]+){0,3}")


class _Said(ast.NodeVisitor):
    """Gathers code (None: there is none) and text of what makes an error of some kinds or tells one to `Talk.error`."""

    def __init__(self, kinds: set[str]) -> None:
        self.kinds, self.found = kinds, list[tuple[ast.expr | None, str]]()
        self.named: dict[str, str] = {}  # the texts that have names, up to the line that is looked at

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        outer, self.named = self.named, {}
        self.generic_visit(node)
        self.named = outer

    def visit_Assign(self, node: ast.Assign) -> None:
        texts = [self.text(node.value)] if isinstance(node.value, (ast.JoinedStr, ast.Constant)) else []
        self.generic_visit(node)
        self.named |= {ast.unparse(node.targets[0]): text for text in texts}

    def visit_Name(self, node: ast.Name) -> None:
        if isinstance(node.ctx, ast.Store):
            self.named.pop(node.id, None)

    def visit_Call(self, node: ast.Call) -> None:
        self.generic_visit(node)
        given = [*node.args, *(keyword.value for keyword in node.keywords if keyword.arg == "code")]
        if isinstance(node.func, ast.Attribute) and ast.unparse(node.func).endswith("talk.error"):
            given.reverse()
        elif getattr(node.func, "id", None) not in self.kinds:
            return
        self.found.append((given[0] if len(given) == 2 else None, self.text(given[-1])))

    def text(self, node: ast.AST) -> str:
        if isinstance(node, ast.JoinedStr):
            return "".join(map(self.text, node.values))
        if isinstance(node, ast.Constant):
            return str(node.value)
        name = ast.unparse(node.value if isinstance(node, ast.FormattedValue) else node)
        name = name.replace('"', "'")  # which of them is used depends on Python's version
        spec = getattr(node, "format_spec", None)
        return self.named.get(name, f"{{{name}:{self.text(spec)}}}" if spec else f"{{{name}}}")


def messages() -> tuple[dict[str, list[str]], list[str]]:
    """Texts by code, and those of errors that have none. `ConfigError` brings its own."""
    kinds, texts = {"DevrfError"}, dict[str, set[str]]()
    files = [path.read_text("utf-8") for room in ROOMS for path in (KEPT.parents[1] / room).rglob("*.py")]
    for _ in range(4):  # a class may come before its base
        found = re.findall(r"^class (\w+)\((\w+)\)", "\n".join(files), re.M)
        kinds |= {name for name, base in found if base in kinds}
    said, makes = _Said(kinds - {"ConfigError"}), re.compile(rf"\b({'|'.join(kinds)}|talk\.error)\(")
    said.visit(ast.parse("\n".join(filter(makes.search, files))))
    for code, text in said.found:
        if code is None or isinstance(code, ast.Constant):  # one that is computed is another error's
            texts.setdefault(str(code.value) if code else "", set()).add(text)
    return {code: sorted(texts[code]) for code in sorted(texts) if code}, sorted(texts.get("", []))


def test_codes_and_texts_are_those_that_are_kept() -> None:
    found, without = messages()
    assert found == json.loads(KEPT.read_text("utf-8")), "if that is intended: python tests/test_messages.py"
    assert [code for code in found if not FORM.fullmatch(code)] == without == []


if __name__ == "__main__":
    KEPT.write_text(json.dumps(messages()[0], indent=1, ensure_ascii=False) + "\n", "utf-8")
