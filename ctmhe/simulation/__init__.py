"""Plants, disturbances, channels, and the loop that runs them with a trigger and an estimator."""

from ctmhe.simulation.channel import Channel, Delivery, Everything, Link, SingleSample, WholeSignal
from ctmhe.simulation.fmu import Checkup, FmuPlant, check_fmu
from ctmhe.simulation.loop import simulate
from ctmhe.simulation.network import Network
from ctmhe.simulation.plants import MapPlant, OdePlant, Plant
from ctmhe.simulation.replay import replay
from ctmhe.simulation.run import Run
from ctmhe.simulation.signals import Gaussian, Recorded, Uniform, Waveform

__all__ = [
    "Channel",
    "Checkup",
    "Delivery",
    "Everything",
    "FmuPlant",
    "Gaussian",
    "Link",
    "MapPlant",
    "Network",
    "OdePlant",
    "Plant",
    "Recorded",
    "Run",
    "SingleSample",
    "Uniform",
    "Waveform",
    "WholeSignal",
    "check_fmu",
    "replay",
    "simulate",
]
