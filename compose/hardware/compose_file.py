"""The compose file of a scenario: a container for the world, for the agent of each robot, and for the page.

The file that ships, for a pair, is its template.
"""

from __future__ import annotations

import json
import os
from importlib import resources
from pathlib import Path

from compose.scenario.shipped_files import shipped
from world.scenario import Scenario

CLONE_FOLDER = Path(__file__).parents[2]
"""The folder from which an image is built: that of a clone of the repository."""
MOUNTED = "/scenario.toml"
"""The place of a scenario file in the container of the world."""
OF_A, OF_B = "  agent-a:\n", "  agent-b:\n"
"""The first lines of the services of the template's agents."""


def template() -> str:
    """Return the compose file that ships."""
    return (resources.files("compose") / "hardware" / "deploy" / "compose.yaml").read_text("utf-8")


def compose_file(source: str, scenario: Scenario, place: Path) -> str:
    """Return the compose file of `scenario`, which is to be at `place`.

    `source` is the name of the scenario if it ships, or the path of its file. Relative paths in a compose
    file begin at its folder.
    """
    text = template()
    text = text[text.index("name: tandem\n") :]
    agent = next(block for block in text.split("\n\n") if block.startswith(OF_A))
    other = next(block for block in text.split("\n\n") if block.startswith(OF_B))
    ids = [robot.id for robot in scenario.robots]
    agents = "\n\n".join(
        [agent.replace("agent-a", f"agent-{one}").replace('"a"', json.dumps(one)) for one in ids]
    )
    changes = {
        "name: tandem\n": f"name: tandem-{scenario.name.lower()}\n",
        f"{agent}\n\n{other}": agents,
        "  agent-a: {}\n  agent-b: {}\n": "".join([f"  agent-{one}: {{}}\n" for one in ids]),
        "context: ../../..\n": f"context: {_quoted(_from(place, CLONE_FOLDER))}\n",
    }
    if source in shipped():
        changes["${TANDEM_SCENARIO:-random}"] = source
    else:
        file = _quoted(_from(place, Path(source)))
        bind = f"{{type: bind, source: {file}, target: {MOUNTED}, read_only: true}}"
        changes["${TANDEM_SCENARIO:-random}"] = MOUNTED
        changes['volumes: ["world:/journal"]'] = f'volumes: ["world:/journal", {bind}]'
    for old, new in changes.items():
        text = text.replace(old, new)
    return text


def _from(place: Path, path: Path) -> str:
    """Return `path` relative to the folder of the file at `place`, beginning with a dot."""
    return f"./{os.path.relpath(path.resolve(), place.parent.resolve())}"


def _quoted(text: str) -> str:
    """Return `text` as a string of YAML in which compose substitutes no variables."""
    return json.dumps(text.replace("$", "$$"))
