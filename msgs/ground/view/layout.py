"""Where things are shown, saved with the data as a blueprint: it opens right the first time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import rerun.blueprint as rrb

TIMELINE = "utc"
TRAIL_S = 30.0
PLOT_S = 60.0
PLOTS = {
    "range": "Range m",
    "closing": "Closing m/s (up: comes nearer)",
    "attitude": "Target roll, pitch, heading °",
    "score": "Score",
    "latency": "Latency and age ms",
}


def blueprint(uavs: Sequence[str]) -> rrb.Blueprint:
    """A tab for each vehicle."""
    tabs = [_vehicle(uav) for uav in uavs]
    root = tabs[0] if len(tabs) == 1 else rrb.Tabs(*tabs)
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        auto_layout=False,
        auto_views=False,
    )


def _vehicle(uav: str) -> rrb.Horizontal:
    picture = rrb.Vertical(
        rrb.Spatial2DView(origin=f"{uav}/ned/camera", name="Camera"),
        rrb.Spatial2DView(origin=f"{uav}/zoom", name="Targets as seen, enlarged", background=[24, 26, 30]),
        rrb.Horizontal(
            rrb.TextDocumentView(origin=f"{uav}/health", name="Health"),
            rrb.TextLogView(origin=f"{uav}/events", name="Events"),
        ),
        row_shares=[4, 2, 3],
    )
    space = rrb.Vertical(
        rrb.Spatial3DView(
            origin=f"{uav}/ned",
            contents=["$origin/**", "- $origin/camera/target/**"],
            name="Scene (north, east, down)",
            overrides=_trails(f"{uav}/ned"),
        ),
        rrb.Spatial2DView(
            origin=f"{uav}/map", name="From above, north up", overrides=_trails(f"{uav}/map"), background=[24, 26, 30]
        ),
    )
    plots = rrb.Vertical(*(_plot(uav, path, name) for path, name in PLOTS.items()))
    return rrb.Horizontal(picture, space, plots, column_shares=[5, 4, 4], name=uav)


def _trails(root: str) -> Mapping[Any, rrb.VisibleTimeRanges]:
    lasting = rrb.VisibleTimeRanges(
        timeline=TIMELINE,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-TRAIL_S),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    return {f"{root}/trail/{who}": lasting for who in ("ship", "targets")}


def _plot(uav: str, path: str, name: str) -> rrb.TimeSeriesView:
    window = rrb.VisibleTimeRange(
        TIMELINE,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-PLOT_S),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    return rrb.TimeSeriesView(
        origin=f"{uav}/plots/{path}",
        name=name,
        time_ranges=window,
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop),
    )
