"""Trains the network that predicts the color of the paint after a stroke.

python -m experiments.train_color                  # from nothing, at most 15 minutes on 2 cores
python -m experiments.train_color --preset small --minutes 600
python -m experiments.train_color --no-time        # without the time map (paper Figure 4)
"""

import tyro

from experiments import train_network
from experiments.common import helped
from experiments.train_network import Config


def main(options: Config) -> None:
    train_network.main("color", options)


if __name__ == "__main__":
    main(tyro.cli(Config, description=helped(__doc__)))
