"""A radio of one's own: the loss of reports grows with the square of the distance."""

from __future__ import annotations

import tandem
from tandem.models import RadioModel, Transmission


class Distant(RadioModel[None]):
    """A report over the distance d is lost with the probability (d / R)^2."""

    def sent(self, state: None, transmission: Transmission) -> tuple[None, int | None]:
        """Return the delay in ticks: 0, or None if the report is lost."""
        radios = transmission.radios
        lost = radios.uniform("loss") < (radios.distance / transmission.reach) ** 2
        return state, None if lost else 0


def main() -> None:
    """Run the same mission with and without the loss, and check that processes decide the same."""
    scenario = tandem.Scenario.load("noisy").with_({"world.radio.model": Distant})
    print(tandem.run("noisy"), tandem.run(scenario), tandem.run(scenario).audit().links)
    assert tandem.run(scenario, processes=True).audit().violations == ()


if __name__ == "__main__":
    main()
