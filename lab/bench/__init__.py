"""What `devrf-pipeline bench` runs: each benchmark prints a table, draws a chart and writes rows as JSON."""
