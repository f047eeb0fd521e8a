"""Numbers and texts that a scene.yaml may hold by mistake or on purpose."""

NUMBERS = (
    0, -1, 1, 2, 3, 0.5, -0.0, 1e-300, 1e300, 10**30, -(10**400), 2**31, 2**63, 2**64, float("nan"), float("inf"),
    -float("inf"),
)  # fmt: skip
TEXTS = (
    "", " ", "auto", "none", "null", "~", "~nobody/x", "~/", "/", ".", "..", "../..", "../static.mp4",
    "/etc/passwd", "/dev/zero", "/dev/stdin", "/proc/self/mem", "photos", "cam0.mp4", "times.csv",
    "rig.toml", "set", "a\0b", "x" * 300, "x/" * 3000, "\ud800", "\u202e\u0007\x1b[31m", "名前", "{image}",
    "-rf", "$(id)", "<script>alert(1)</script>", "[bold", "[/]", "CON", "nul", "Cam0", "static", "board_x",
    "DICT_", "DICT_MAX", "DICT_ARUCO_ORIGINAL", "#12345", "5" * 5000, "link", "loop", "fifo",
)  # fmt: skip
WORDS = (
    "chessboard", "aruco_grid", "end", "none", "audio", "motion", "flash", "timestamps", "board", "sweep",
    "given", "global", "both", "points", "chart", "raft", "reference", "background", "command", "devrf",
    "blender", "llff", "colmap", "shell", "fisheye", "DICT_4X4_50", "m", "mm", "photos/0.png", "photo.png",
    "static.mp4", "download", "./", "set/transforms.json",
)  # fmt: skip
RAW_TEXTS = (
    "2020-13-45", "!!binary x", "!!int ''", "!!float x", "!!timestamp 9999-99-99",
    "!!python/object/apply:os.system [id]", "!!set {a, b}", "!!omap [a: 1]", "*missing", "&a [*a]", "0b",
    "0x", "0o9", "1:99:99", "!!bool maybe", "? [a]", "- - -", "{", "[", "'", '"', "|", ">", "%", "@", "`",
    "\t", "<<: *x", "<<: [1]", "<<: 3", "{<<: {a: 1}}", "!!map [1]", "!!seq x", "!<tag:x> y", "'\\ud800'",
    '"\\ud800"', '"\\x00"', "9" * 5000, "1" + "0" * 400, "1e99999", "!!null x", "=", "2001-01-01",
    "2001-12-14t21:59:43.10-99:99", "{? {a: 1} : 2}", "[[[[]]]]", "---", "...", "\ufeff", "#",
    "!!pairs [a: 1]",
)  # fmt: skip
