"""`run.foxglove.json`: a layout for Foxglove and Lichtblick that shows `run.mcap` without configuration.

It has the form in which these programs export and import layouts: panels by name, and how they divide the
window. The settings of each panel are values of Foxglove's own types.
"""

from __future__ import annotations

from typing import Any

import foxglove.layouts as fl
import msgspec

from compose.recording.run_setup import RunSetup
from compose.view import colours
from compose.view.foxglove.views import WORLD_FRAME
from compose.view.numbers import PLOTS, PLOTTED
from compose.view.outlines import box

ROBOT_TOPICS = {"body": True, "belief": True, "pose": False, "trail": False, "hypotheses": False}
"""The topics of a robot, and whether the scene shows them; these contain what the others have."""
HEIGHT_MARGIN = 1.15
"""The shown height, as a multiple of the extent of the sensing ranges and orbits."""
FAR_M = 5000.0
"""The least distance of the camera's far plane."""
SCENE_PERCENT, LOG_PERCENT = 60, 30
"""The widths and heights of the panels, in percent of the window."""


def layout(setup: RunSetup) -> bytes:
    """Return the layout of a run: its scene, seen from above, beside its plots and its log."""
    plots = {f"Plot!{title.split()[0].lower()}": _plot(setup, title) for title in PLOTS}
    panels = {
        "3D!scene": _scene(setup),
        **plots,
        "RosOut!log": fl.LogConfig(topic_to_render="/log", min_log_level=1),
    }
    parts: Any = "RosOut!log"
    for place, plot in enumerate(reversed(plots)):
        share = LOG_PERCENT if place == 0 else round(100 / (len(plots) - place + 1))
        parts = {"direction": "column", "first": plot, "second": parts, "splitPercentage": 100 - share}
    made = {
        "configById": {name: msgspec.json.decode(config.to_json()) for name, config in panels.items()},
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {
            "direction": "row",
            "first": "3D!scene",
            "second": parts,
            "splitPercentage": SCENE_PERCENT,
        },
    }
    return msgspec.json.format(msgspec.json.encode(made), indent=1) + b"\n"


def _scene(setup: RunSetup) -> fl.ThreeDeeConfig:
    """Return the scene, which follows nothing and contains all sensing ranges and orbits."""
    scene = box(setup)
    shown = {f"/{robot}/{topic}": visible for robot in setup.ids for topic, visible in ROBOT_TOPICS.items()}
    frames = [WORLD_FRAME, *[frame for robot in setup.ids for frame in (robot, f"{robot}/anchor")]]
    return fl.ThreeDeeConfig(
        camera_state=fl.ThreeDeeCameraState(
            perspective=False,
            distance=HEIGHT_MARGIN * scene.extent,
            phi=0.0,
            theta_offset=0.0,
            target=(0.0, 0.0, 0.0),
            target_offset=(scene.x, scene.y, 0.0),
            target_orientation=(0.0, 0.0, 0.0, 1.0),
            fovy=45.0,
            near=0.5,
            far=max(FAR_M, 10.0 * scene.extent),
        ),
        follow_mode="follow-none",
        follow_tf=WORLD_FRAME,
        transforms={f"frame:{one}": fl.BaseRendererLayerSettingsTransform(visible=False) for one in frames},
        topics={
            topic: fl.BaseRendererSceneUpdateTopicSettings(visible=visible)
            for topic, visible in {"/stage": True, "/contact": True, **shown}.items()
        },
    )


def _plot(setup: RunSetup, title: str) -> fl.PlotConfig:
    """Return a plot of the numbers of the first robots."""
    numbers = PLOTS[title]
    return fl.PlotConfig(
        paths=[
            fl.PlotSeries(
                value=f"/{robot.id}/numbers.{number}",
                label=f"{robot.id}: {number}" if len(numbers) > 1 else robot.id,
                color=colours.COLOURS[robot.role] if len(setup.robots) == 2 else None,
                line_style="solid" if place == 0 else "dashed",
                line_interpolation="step" if number == "hypotheses" else "linear",
                enabled=True,
                show_line=True,
                timestamp_method="receiveTime",
            )
            for robot in setup.robots[:PLOTTED]
            for place, number in enumerate(numbers)
        ],
        y_axis_label=title,
        x_axis_val="timestamp",
        min_y_value=0.0,
        show_legend=True,
        legend_display="floating",
        show_x_axis_labels=True,
        show_y_axis_labels=True,
        is_synced=True,
    )
