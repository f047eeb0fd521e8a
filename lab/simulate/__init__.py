"""Sessions and data sets rendered with known truth (Mitsuba, optional extra)."""
