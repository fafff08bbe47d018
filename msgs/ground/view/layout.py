"""Layout of the views, stored with the data as a Rerun blueprint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import rerun.blueprint as rrb

TIMELINE = "utc"
TRAIL_S = 30.0
PLOT_S = 60.0
DARK = [24, 26, 30]
EYE_M = [-90.0, -130.0, -90.0]  # behind, left of and above the own ship
LOOK_AT_M = [130.0, 0.0, 0.0]
PLOTS = {
    "range": "Range m",
    "closing": "Closing m/s (up: comes nearer)",
    "attitude": "Target roll, pitch, heading °",
    "score": "Score",
    "latency": "Latency and age ms",
}


def blueprint(uavs: Sequence[str], *, live: bool) -> rrb.Blueprint:
    """One tab per vehicle; time follows new data if `live`, otherwise it plays from the beginning."""
    tabs = [_vehicle(uav) for uav in uavs]
    root = tabs[0] if len(tabs) == 1 else rrb.Tabs(*tabs)
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following" if live else "playing"),
        auto_layout=False,
        auto_views=False,
    )


_EVENT_COLUMNS = rrb.TextLogColumns(
    timeline_columns=[rrb.encodings.TimelineColumn(TIMELINE)],
    text_log_columns=["LogLevel", "Body"],
)


def _vehicle(uav: str) -> rrb.Horizontal:
    picture = rrb.Vertical(
        rrb.Spatial2DView(origin=f"{uav}/ned/camera", name="Camera"),
        rrb.Spatial2DView(
            origin=f"{uav}/zoom",
            name="Targets as seen, enlarged: nose red, right green, down blue",
            background=DARK,
            visual_bounds=_bounds(-1.1, 1.1, -1.0, 1.1),
        ),
        rrb.Horizontal(
            rrb.TextDocumentView(origin=f"{uav}/health", name="Health"),
            rrb.TextLogView(origin=f"{uav}/events", name="Events", columns=_EVENT_COLUMNS),
        ),
        row_shares=[4, 2, 3],
    )
    space = rrb.Vertical(
        rrb.Spatial3DView(
            # The view follows the own ship's position, but does not rotate with it.
            origin=f"{uav}/ned/place",
            contents=[f"+ /{uav}/ned/**", f"- /{uav}/ned/camera/target/**", f"- /{uav}/ned/camera/frame"],
            name="Scene: own ship blue",
            background=DARK,
            eye_controls=rrb.EyeControls3D(position=EYE_M, look_target=LOOK_AT_M, eye_up=[0.0, 0.0, -1.0]),
            overrides=_trails(f"{uav}/ned"),
        ),
        rrb.Spatial2DView(
            origin=f"{uav}/map",
            name="From above, north up, own ship in the middle",
            overrides=_trails(f"{uav}/map"),
            background=DARK,
            visual_bounds=_bounds(-540.0, 540.0, -540.0, 540.0),
        ),
    )
    plots = rrb.Vertical(*(_plot(uav, path, name) for path, name in PLOTS.items()))
    return rrb.Horizontal(picture, space, plots, column_shares=[5, 4, 4], name=uav)


def _bounds(left: float, right: float, top: float, bottom: float) -> rrb.VisualBounds2D:
    return rrb.VisualBounds2D(x_range=[left, right], y_range=[top, bottom])


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
