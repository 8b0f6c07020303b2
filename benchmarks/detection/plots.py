"""Figures and tables of the detection benchmark."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from rich.table import Table

from jaxsonar.reports import plot_style

KINDS = ("plane", "corner", "edge", "circle")
"""Kinds of reflectors. Poles count as edges."""
KIND_TITLES = {"edge": "edge, pole"}
"""Kinds that are named otherwise in tables and figures."""
ANSWERS = (*KINDS, "undecided", "nothing")
"""Classes that a method can report for a reflector."""
Series = dict[float, dict[str, dict[str, float]]]
"""Measures of each method by the value of the varied parameter."""
MARKERS = ("o", "s", "^", "v", "D", "P")
WIDE = 15.0
"""Upper limit of the NEES axis."""


def crb_figure(rows: dict[str, Series]) -> Figure:
    """Root mean square errors over the bound by noise, one row per kind of scans."""
    with plot_style.figure_style():
        figure = Figure(figsize=(7.6, 2.9 * len(rows) + 0.7), layout="constrained")
        grid = figure.subplots(len(rows), 2, sharex=True, sharey="col", squeeze=False)
        for (title, series), row in zip(rows.items(), grid, strict=True):
            for axes, (name, key) in zip(
                row, {"distance ρ": "rho_mm", "direction θ": "theta_deg"}.items(), strict=True
            ):
                axes.axhline(1.0, color=plot_style.WALL_COLOR, lw=1.0, ls="--")
                _lines(axes, series, f"rmse_{key}_per_crb", across=1e3)
                axes.set_yscale("log")
                axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
                axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
                axes.yaxis.set_minor_formatter(NullFormatter())
                axes.set_title(f"{name}; {title}")
            row[0].set_ylabel("RMSE / CRB")
        for axes in grid[-1]:
            axes.set_xlabel("range noise σ (mm)")
        return _with_legend(figure, grid[0, 0], "CRB")


def robustness_figure(columns: dict[str, Series]) -> Figure:
    """Recall and false lines by the share of lost or false echoes, one column each."""
    with plot_style.figure_style():
        figure = Figure(figsize=(7.6, 5.6), layout="constrained")
        grid = figure.subplots(2, len(columns), sharex="col", sharey="row", squeeze=False)
        for (name, series), (top, bottom) in zip(columns.items(), grid.T, strict=True):
            _lines(top, series, "recall", across=100, up=100)
            _lines(bottom, series, "false_per_scan", across=100)
            bottom.set_xlabel(name)
            bottom.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        grid[1, 0].set_ylim(bottom=-0.03 * grid[1, 0].get_ylim()[1])  # 0, and whole markers on it
        grid[0, 0].set_ylabel("walls found (%)")
        grid[1, 0].set_ylabel("false lines a scan")
        return _with_legend(figure, grid[0, 0])


def confusion_figure(tables: dict[str, Int[np.ndarray, "rows answers"]]) -> Figure:
    """Confusion matrices of the methods, with the number of reports without a reflector."""
    across, kinds = 3, len(KINDS)
    down = -(-len(tables) // across)
    with plot_style.figure_style():
        figure = Figure(figsize=(9.4, 3.0 * down + 0.4), layout="constrained")
        grid = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False)
        for axes in grid.ravel()[len(tables) :]:
            axes.set_axis_off()
        for (name, table), axes in zip(tables.items(), grid.ravel(), strict=False):
            share = np.full(table.shape, np.nan)
            share[:kinds] = table[:kinds] / np.maximum(table[:kinds].sum(axis=1, keepdims=True), 1)
            axes.imshow(share, cmap="Blues", vmin=0, vmax=1, aspect="auto")
            for (row, column), count in np.ndenumerate(table):
                if count and (row < kinds or column < len(ANSWERS) - 1):
                    percent = f"\n{100 * share[row, column]:.0f} %" if row < kinds else ""
                    color = "white" if share[row, column] > 0.5 else plot_style.ROBOT_COLOR
                    axes.text(column, row, f"{count}{percent}", ha="center", va="center", fontsize=7, color=color)
            axes.set_title(name)
            axes.set_xticks(range(len(ANSWERS)), ANSWERS, rotation=30, ha="right", rotation_mode="anchor")
            axes.set_yticks(range(kinds + 1), [*(KIND_TITLES.get(kind, kind) for kind in KINDS), "nothing"])
            axes.tick_params(length=0)
            axes.spines[:].set_visible(False)
        figure.supxlabel("reported", fontsize=9)
        figure.supylabel("true", fontsize=9)
    return figure


def nees_figure(values: dict[str, Float[np.ndarray, " walls"]]) -> Figure:
    """Histograms of the NEES with the chi-squared density of two degrees of freedom."""
    values = {name: some for name, some in values.items() if len(some)}
    with plot_style.figure_style():
        figure = Figure(figsize=(3.0 * max(len(values), 1) + 0.6, 3.0), layout="constrained")
        if not values:
            figure.text(0.5, 0.5, "no method reports a covariance", ha="center")
            return figure
        grid = figure.subplots(1, len(values), sharey=True, squeeze=False)[0]
        x = np.linspace(0, WIDE, 200)
        for axes, (name, some) in zip(grid, values.items(), strict=True):
            inside = some[some < WIDE]
            bins = np.linspace(0, WIDE, 31)
            weight = np.full(len(inside), 1 / (len(some) * (bins[1] - bins[0])))
            axes.hist(inside, bins, weights=weight, color=plot_style.PALETTE[4], label=f"{len(some)} walls")
            axes.plot(x, np.exp(-x / 2) / 2, color=plot_style.ROBOT_COLOR, lw=1.2, label="χ², 2 degrees of freedom")
            beyond = f"{100 * np.mean(some >= WIDE):.2f} % beyond {WIDE:g} (χ²: {100 * np.exp(-WIDE / 2):.2f} %)"
            axes.plot([], [], " ", label=f"mean {some.mean():.2f}, 2 is right\n{beyond}")
            axes.set_title(name)
            axes.set_xlabel("NEES of (ρ, θ)")
            axes.legend(fontsize=7)
        grid[0].set_ylabel("density")
    return figure


def tables(content: dict[str, Any]) -> Iterator[Table]:
    """Tables to print, from the content of the JSON file. The first condition is the base."""
    v, s, base = content["versions"], content["settings"], content["conditions"][0]
    table = Table(
        title=f"Walls with {s['clear_echoes']} or more received first-order echoes; "
        f"{s['rooms']} random rooms, {s['poses']} poses each, seed {s['seed']}",
        caption=f"base: {_condition_text(base)}; undec.: % of the walls that are undecided; ± standard error; "
        "/CRB: ratio of root mean squares; 99 %: quantile of |error| / CRB; NEES: mean, 2 is consistent. "
        f"numpy {v['numpy']}, jax {v['jax']} on {v['device']}, OpenCV {v['opencv-python-headless']}",
    )
    columns = ("", "walls", "recall (%)", "undec.", "false/scan", "RMSE (mm)", "(deg)", "median (mm)", "(deg)")
    for column in (*columns, "ρ/CRB", "θ/CRB", "99 % ρ", "99 % θ", "NEES"):
        table.add_column(column, justify="left" if not column else "right", no_wrap=True)
    for condition in content["conditions"]:
        table.add_section()
        table.add_row(f"[bold]{condition['name']}[/]")
        for name, got in condition["methods"].items():
            table.add_row(
                f"  {name}",
                str(got["walls"]),
                f"{100 * got['recall']:.1f} ± {100 * got['recall_se']:.1f}",
                f"{100 * got['undecided']:.1f}",
                f"{got['false_per_scan']:.2f} ± {got['false_per_scan_se']:.2f}",
                *(f"{got[key]:.2f}" for key in ("rmse_rho_mm", "rmse_theta_deg", "median_rho_mm", "median_theta_deg")),
                *(f"{got[f'rmse_{key}_per_crb']:.2f}" for key in ("rho_mm", "theta_deg")),
                *(f"{got[f'p99_{key}_per_crb']:.1f}" for key in ("rho_mm", "theta_deg")),
                "" if np.isnan(got["nees"]) else f"{got['nees']:.2f} ± {got['nees_se']:.2f}",
            )
    yield table
    table = Table(
        title=f"Classification of reflectors with {s['clear_reflector']} or more echoes: % of each kind; "
        f"{_condition_text(base)}",
        caption="nothing there: reports per scan without a reflector, from second-order and false echoes",
    )
    for column in ("", "true", "reflectors", *(f"as {answer}" for answer in ANSWERS)):
        table.add_column(column, justify="left" if column in ("", "true") else "right")
    for name, got in base["methods"].items():
        table.add_section()
        for row, (kind, cells) in enumerate(zip((*KINDS, "nothing there"), got["confusion"], strict=True)):
            true = row < len(KINDS)
            total = sum(cells) if true else got["scans"]
            shares = [f"{100 * k / max(total, 1):.1f}" if true else f"{k / total:.2f}" for k in cells]
            what = KIND_TITLES.get(kind, kind)
            if total:
                table.add_row("" if row else name, what, *([str(total), *shares] if true else ["", *shares[:-1]]))
    yield table
    table = Table(
        title=f"One reflector at {s['ranges_m'][0]} to {s['ranges_m'][1]} m: a plane, a right-angled corner, an edge "
        "or a circle of 0.05 to 1 m radius; hard cones",
        caption="correct: share of the decided ones; Bayes error: of the same scans, if the echoes are known to be of "
        "one reflector and each kind is equally likely",
    )
    for column in ("", "reflectors", "correct (%)", "undecided (%)", "missed (%)"):
        table.add_column(column, justify="left" if not column else "right")
    for condition in content["isolated"]:
        table.add_section()
        error = f"Bayes error {100 * condition['bayes_error']:.1f} %"
        table.add_row(f"[bold]{condition['name']}[/]; {error}")
        for name, got in condition["methods"].items():
            shares = f"{100 * got['undecided']:.2f}", f"{100 * got['nothing']:.2f}"
            right = f"{100 * got['right']:.2f} ± {100 * got['right_se']:.2f}"
            table.add_row(f"  {name}", str(got["reflectors"]), right, *shares)
    yield table
    table = Table(
        title="Largest deviation of three long walls from one scan, sigma 1 mm",
        caption="scans in which all three were found; the paper: "
        f"{content['paper']['rho_mm']} mm, {content['paper']['theta_deg']} deg",
    )
    for column in ("", "scans", "all found (%)", "median (mm)", "90 % (mm)", "median (deg)", "90 % (deg)"):
        table.add_column(column, justify="left" if not column else "right")
    for name, got in content["three"][0]["methods"].items():
        values = (got[f"{key}_p{share}"] for key in ("rho_mm", "theta_deg") for share in (50, 90))
        table.add_row(name, str(got["scans"]), f"{100 * got['all_found']:.1f}", *(f"{x:.2f}" for x in values))
    yield table


def _lines(axes: Axes, series: Series, key: str, *, across: float = 1.0, up: float = 1.0) -> None:
    """Plot a measure of each method over the varied parameter, with standard errors."""
    names = list(dict.fromkeys(name for row in series.values() for name in row))
    values = across * np.array(list(series), dtype=float)
    beside = 0.008 * np.ptp(values)  # the error bars of the methods stand side by side
    for k, name in enumerate(names):
        x = values + beside * (k - (len(names) - 1) / 2)
        y, error = (
            np.array([up * row[name][f"{key}{of}"] for row in series.values()], dtype=float) for of in ("", "_se")
        )
        style = {"color": plot_style.PALETTE[k % 6], "marker": MARKERS[k % 6], "ms": 4.5, "lw": 1.3, "label": name}
        axes.errorbar(x, y, error, capsize=2, **style)
    axes.grid(axis="y", color="#F0F0F0", lw=0.6)
    axes.set_axisbelow(True)


def _with_legend(figure: Figure, axes: Axes, *first: str) -> Figure:
    handles, labels = axes.get_legend_handles_labels()
    reference = [line for line in axes.lines if line.get_linestyle() == "--"][: len(first)]
    figure.legend([*reference, *handles], [*first, *labels], loc="outside lower center", ncols=4, fontsize=8)
    return figure


def _condition_text(c: dict[str, Any]) -> str:
    """Text of a condition."""
    return (
        f"{c['sigma'] * 1e3:g} mm, {100 * c['lost']:g} % lost, {100 * c['false']:g} % false, "
        f"{c['beams']} cones of {c['cone_deg']:g} deg, {c['sensors']} sensors"
    )
