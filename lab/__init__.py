"""What measures the product and makes worlds for it to be measured on; a capture's run needs nothing of it."""

if __name__ != "devrf.lab":
    raise ImportError("import devrf.lab, not lab")
