import ast,sys,collections
from pathlib import Path
d=collections.defaultdict(list)
for p in sorted(Path("tests").rglob("*.py")):
    t=ast.parse(p.read_text())
    for n in t.body:
        if isinstance(n,(ast.FunctionDef,ast.ClassDef)) and not n.name.startswith("test_"):
            d[n.name].append((str(p)[6:],n.end_lineno-n.lineno+1))
for k,v in sorted(d.items(), key=lambda kv:-len(kv[1])):
    if len(v)>1: print(k,len(v),sum(x[1] for x in v),[f"{a}:{b}" for a,b in v])
