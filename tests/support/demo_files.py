"""Names of the files that the demo writes."""

FIGURES = (
    "1-ring", "2-reference", "3-arcs", "4-lines", "4-accumulator", "5-modeling", "6-segments", "7-map", "8-grid",
    "9-grids",
)  # fmt: skip
FILES = {
    *(f"{name}.{suffix}" for name in FIGURES for suffix in ("svg", "png")),
    *("office.csv", "path.csv", "office.geojson", "ring.toml", "lines.jsonl", "lines.settings.toml", "table.json"),
    *("map.geojson", "map.yaml", "map.pgm", "map-table.json", "index.html"),
}
