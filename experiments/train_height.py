"""The main job: trains the network that predicts the height of the paint after a stroke.

python -m experiments.train_height                 # from nothing, at most 15 minutes on 2 cores
python -m experiments.train_height --preset small --minutes 600
python -m experiments.train_height --resume --minutes 30
"""

import tyro

from experiments import train_network
from experiments.common import helped
from experiments.train_network import Config


def main(options: Config) -> None:
    train_network.main("height", options)


if __name__ == "__main__":
    main(tyro.cli(Config, description=helped(__doc__)))
