"""Ground truth by simulation; shares no code with the renderer that is fitted."""

from data_modules.simulate.bodies import BODIES, Body, assemble, bodies_from, one_line
from data_modules.simulate.capture import simulate_capture
from data_modules.simulate.draw import DrawnScene, draw_scene
from data_modules.simulate.mesh import Mesh, join, load_mesh
from data_modules.simulate.plan import ScanPlan, wall_grid
from data_modules.simulate.scenes import SCENES, bunny_two_albedo, default_scene, letters
from data_modules.simulate.sensor import SensorModel
from data_modules.simulate.transients import simulate_transients
from data_modules.simulate.truth import Truth, load_truth, save_truth

__all__ = [
    "BODIES",
    "SCENES",
    "Body",
    "DrawnScene",
    "Mesh",
    "ScanPlan",
    "SensorModel",
    "Truth",
    "assemble",
    "bodies_from",
    "bunny_two_albedo",
    "default_scene",
    "draw_scene",
    "join",
    "letters",
    "load_mesh",
    "load_truth",
    "one_line",
    "save_truth",
    "simulate_capture",
    "simulate_transients",
    "wall_grid",
]
