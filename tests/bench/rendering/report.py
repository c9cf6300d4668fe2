"""One HTML page with the suite's pictures and figures, for looking at."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

WORDS = {
    "presets": "Fig. 7.11: the presets beside the truth",
    "bounce": "Fig. 7.10: indirect light",
    "turning": "Fig. 7.8: an occluder leaves the picture",
}
"""Of the sheets that are not one set's."""
_STYLE = (
    "body{font:15px/1.4 sans-serif;margin:2em;color:#222}img{max-width:100%}table{border-collapse:collapse}"
    "td,th{padding:2px 10px;text-align:left;border-bottom:1px solid #ddd}.no{color:#b00;font-weight:bold}"
)


def write_report(folder: Path, result: dict[str, Any]) -> Path:
    """Write `folder`/report.html of the pictures that lie there and of `result`; returns it."""
    pictures = sorted(path.name for path in folder.glob("*.jpg"))
    first = [f"{name}.jpg" for name in WORDS if f"{name}.jpg" in pictures]
    body = [f"<h1>Rendering</h1><p>Commit {escape(result['commit'])} on {escape(result['device'])}.</p>"]
    for name in first + [name for name in pictures if name not in first]:
        words = WORDS.get(Path(name).stem, Path(name).stem)
        body.append(f'<h2>{escape(words)}</h2><p><img src="{escape(name)}" alt="{escape(words)}"></p>')
    body += ["<h2>Figures</h2>", _table(result)]
    for missing in result["unmeasured"]:
        body.append(f"<p>Not measured: {escape(missing['name'])}: {escape(missing['reason'])}</p>")
    page = f"<!doctype html><meta charset=utf-8><title>Rendering</title><style>{_STYLE}</style>" + "\n".join(body)
    path = folder / "report.html"
    path.write_text(page, encoding="utf-8")
    return path


def _table(result: dict[str, Any]) -> str:
    rows = ["<table><tr><th>row<th>value<th>unit<th>goal<th>holds</tr>"]
    for row in result["rows"]:
        holds = {True: "<td>yes", False: '<td class="no">no', None: "<td>"}[row["holds"]]
        values = (row["name"], f"{row['value']:.4g}", row["unit"], row["goal"] or "")
        rows.append("<tr>" + "".join(f"<td>{escape(value)}" for value in values) + holds + "</tr>")
    return "\n".join([*rows, "</table>"])
