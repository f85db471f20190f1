#!/usr/bin/env python3
"""Opens a file for viewers in Rerun, with maps, chirps, answers, state and events side by side: `rerun.py FILE.mcap`.

Needs the package rerun-sdk (0.41). `rerun.py FILE.mcap --save FILE.rrd` writes what Rerun would show instead.
"""

import sys

# This file has the package's name: the folder of a script comes first where Python looks.
sys.path.pop(0)

import rerun
import rerun.blueprint as blueprint
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping


def lines(topic, message, fields):
    """View of numbers of a topic over time."""
    drawn = [
        rerun.SeriesLines(names=[field]).visualizer(
            mappings=[
                VisualizerComponentMapping(
                    "Scalars:scalars",
                    ComponentSourceKind.SourceComponent,
                    source_component=f"{message}:message",
                    selector=f".{field}",
                )
            ]
        )
        for field in fields
    ]
    return blueprint.TimeSeriesView(origin=topic, name=topic.split("/")[-1], overrides={topic: drawn})


def layout():
    """Images to the left, numbers and events to the right."""
    return blueprint.Blueprint(
        blueprint.Horizontal(
            blueprint.Vertical(
                blueprint.Spatial2DView(origin="/radome/map", name="map"),
                blueprint.Spatial2DView(origin="/radome/chirps", name="chirps"),
            ),
            blueprint.Vertical(
                lines("/radome/answer", "radome.Answer", ["p_empty", "p_one", "p_two"]),
                lines("/radome/state", "radome.State", ["true_people", "frames_per_s"]),
                blueprint.TextLogView(origin="/radome/events", name="events"),
            ),
        ),
        collapse_panels=True,
    )


def main():
    path, *save = sys.argv[1:]
    rerun.init("radome", spawn=not save)
    if save:
        rerun.save(save[1], default_blueprint=layout())
    else:
        rerun.send_blueprint(layout())
    rerun.log_file_from_path(path)


if __name__ == "__main__":
    main()
