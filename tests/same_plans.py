"""A measurement: do random fault plans give the same journals as processes and in one process?

    uv run python -m tests.same_plans 20

It prints a line per plan and a verdict. The exit status is 0 if all journals are the same. The number of a
plan is its seed.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
from pathlib import Path

from compose.scenario.scenario_file import parse
from tests.commands import SECTION_IV, journals, tandem
from tests.surveys import ODOMETRY, SIGMA, WHEELS

EXACT, RANGES, ALL_NOISE = "", SIGMA, f"{SIGMA}\noutliers = 0.05\n{WHEELS}\n{ODOMETRY}"
MAX_TICKS = 300
"""The length of a mission. A plan that delivers almost no report ends undecided, which is fine, too."""


def main(count: int) -> int:
    """Run `count` plans; return 0 if every journal is the same in both cases."""
    different = 0
    for number in range(1, count + 1):
        text = scenario(random.Random(number))
        parse(text, f"plan {number}")
        with tempfile.TemporaryDirectory(prefix="tandem-same-") as folder:
            outcomes, found = run_both_ways(text, Path(folder))
        same = found[0] == found[1] != {} and outcomes[0] == outcomes[1]
        different += not same
        amount = f"{len(found[0])} journals, {sum(map(len, found[0].values()))} bytes"
        print(
            f"{number:3} {'same' if same else 'DIFFERENT'}: {outcomes[0]}; {amount}; {described(text)}",
            flush=True,
        )
        if not same:
            for name in sorted(found[0].keys() | found[1].keys()):
                if found[0].get(name) != found[1].get(name):
                    print(f"    {name} differs; as processes {outcomes[0]}, in one process {outcomes[1]}")
    print(f"{count - different} of {count} plans give the same bytes in both cases")
    return 1 if different else 0


def run_both_ways(text: str, folder: Path) -> tuple[list[str], list[dict[str, bytes]]]:
    """Run a plan as processes, then in one process; return the outcomes and the journals."""
    (folder / "plan.toml").write_text(text)
    outcomes, found = [], []
    for out, mode in (("processes", []), ("one-process", ["--in-process"])):
        ended = tandem("run", "plan.toml", "-q", "--out", out, *mode, cwd=folder)
        outcomes.append(ended.out.strip() or ended.err.strip())
        found.append(journals(folder / out))
    return outcomes, found


def scenario(draw: random.Random) -> str:
    """Return a scenario with one to four faults; a third have noise, and a fifth of the others two pairs."""
    noise = draw.choice((EXACT, EXACT, EXACT, EXACT, RANGES, ALL_NOISE))
    planner_name = draw.choice(("assured", "assured", "assured", "paper"))
    pairs = 2 if draw.random() < 0.2 and not noise else 1
    anchors = [(10.0 * (i % 2), 40.0 * (i // 2)) for i in range(2 * pairs)]
    robots = "".join(
        f'[[robot]]\nid = "{robot}"\npeer = "{peer}"\nanchor = [{x}, {y}]\n'
        for robot, peer, (x, y) in zip("abcd", "badc", anchors, strict=False)
    )
    faults = "".join(f"[[fault]]\n{fault(draw, pairs)}" for _ in range(draw.randint(1, 4)))
    table = f"[mission.noise]\n{noise}\n" if noise else ""
    return (
        f'name = "plan"\nseed = {draw.randrange(2**32)}\nmax_ticks = {MAX_TICKS}\n'
        f'planner = {{name = "{planner_name}"}}\n{SECTION_IV}{table}{robots}{faults}'
    )


def fault(draw: random.Random, pairs: int) -> str:
    """Return the table of a random fault."""
    links = ["*", "a->b", "b->a", "a<->b", *(["c->d", "c<->d"] if pairs == 2 else [])]
    lines = [f'link = "{draw.choice(links)}"']
    least, most = sorted((draw.randrange(11), draw.randrange(11)))
    begin, ticks = draw.randrange(10), draw.randrange(30)
    options = (
        f"loss = {draw.uniform(0.0, 0.9):.3f}",
        f"burst_start = {draw.uniform(0.0, 0.5):.3f}\nburst_end = {draw.uniform(0.05, 1.0):.3f}",
        f"delay = [{least}, {most}]",
        f"duplicate = {draw.random():.3f}",
        f"reorder = {draw.random():.3f}",
        f"corrupt = {draw.uniform(0.0, 0.8):.3f}",
        f"reports_per_tick = {draw.uniform(0.1, 2.0):.3f}",
        f"partition = true\ncontact_ticks = [{begin}, {begin + ticks}]",
    )
    lines += [line for line in options if draw.random() < 0.4]
    return "\n".join(lines) + "\n"


def described(text: str) -> str:
    """Return a plan as one line of text."""
    planner_name = "paper" if '"paper"' in text else "assured"
    noise = "noisy" if "mission.noise" in text else "exact"
    pairs = text.count("[[robot]]") // 2
    faults = [" ".join(part.split()) for part in text.split("[[fault]]")[1:]]
    return f"{planner_name}, {noise}, {pairs} pair{'s' if pairs > 1 else ''}; {' | '.join(faults)}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("count", type=int, nargs="?", default=20)
    sys.exit(main(parser.parse_args().count))
