"""Flight by JSBSim: own ship, targets and the camera that looks at them. Start at `fly.fly_encounter`."""

from sim_replay.flight.encounter import Encounter, EncounterPlan
from sim_replay.flight.fly import fly_encounter
from sim_replay.flight.jsbsim_flight import FlightError
from sim_replay.flight.track import Track

__all__ = ["Encounter", "EncounterPlan", "FlightError", "Track", "fly_encounter"]
