"""An example for each public name: shown on its page, run by tests/test_docs.py. Each stands alone."""

_BALL = """
body = shapes.ball(centre=(0.5, 0.2, 0.5), radius=0.1, spacing=0.05, velocity=(0.0, -1.0, 0.0))
simulator = Simulator(Scene(cells=16, dt=1e-3), body, device="cpu")
"""
_TEST = """
from pathlib import Path

folder = Path("rubber")
folder.mkdir(exist_ok=True)
(folder / "tensile.csv").write_text("stretch,stress\\n1.0,0\\n1.2,2.1e5\\n1.5,4.1e5\\n2.0,7.0e5\\n2.5,9.3e5\\n3.0,1.17e6\\n3.5,1.38e6\\n")
(folder / "test.yaml").write_text('''
format: neuido-material-test/1
name: rubber
model: {density: 930, elasticity: {law: neo_hookean, young: 1.2e6, poisson: 0.499}, free: [young], incompressible: true}
tests:
  - {name: tensile, file: tensile.csv, mode: uniaxial, columns: {stretch: stretch, nominal_stress: stress}, role: fit}
''')
"""

EXAMPLES = {
    "AttachedMass": """
from neuido import AttachedMass, Box, Scene

weight = AttachedMass(box=Box((0.4, 0.4, 0.4), (0.6, 0.6, 0.6)), mass=0.05)  # 50 g over the particles in the box
scene = Scene(attached_masses=(weight,))
""",
    "Attachment": """
from neuido import Attachment, Box, Scene

held = Attachment(Box((0.4, 0.8, 0.4), (0.6, 0.9, 0.6)), stiffness=200.0, damping=1.0)  # N/m and N s/m of all these particles together
scene = Scene(attachments=(held,))
""",
    "Body": """
import torch

from neuido import Body

x = torch.rand(100, 3) * 0.2 + 0.4  # 100 particles of your own, m
body = Body(x, v=torch.zeros(100, 3), volume=torch.full((100,), 0.2**3 / 100))
""",
    "Box": """
from neuido import Box, Scene

scene = Scene(clamps=(Box(lower=(0.0, 0.4, 0.4), upper=(0.05, 0.6, 0.6)),))  # what lies in the box is held still
""",
    "Cameras": """
from neuido.data import cameras

around = cameras.orbit(4, width=100, height=100)  # four cameras around the unit cube
print(around.viewmats.shape, around.Ks.shape)
""",
    "colliders": """
from neuido import Scene, Simulator, colliders, laws, shapes

ball = colliders.Sphere(0.15, position=(0.5, 0.2, 0.5), friction=0.3, name="ball")
body = shapes.box(lower=(0.4, 0.4, 0.4), upper=(0.6, 0.6, 0.6), spacing=0.05)
simulator = Simulator(Scene(cells=16, dt=1e-3, colliders=(ball,)), body, device="cpu")
frames = simulator.rollout(100, laws.FixedCorotated(5e4, 0.3), every=50)
print(frames.forces[-1, 0])  # N
""",
    "configs_root": """
import neuido

print(sorted(path.name for path in neuido.configs_root().glob("*.yaml")))
""",
    "diagnose": f"""
from neuido import diagnose
{_TEST}
diagnosis = diagnose(folder, effects=["strain_stiffening", "second_invariant"], draws=19, device="cpu")
print(diagnosis.summary())
""",
    "Diagnosis": f"""
from neuido import Diagnosis, diagnose
{_TEST}
diagnose(folder, out="found", effects=["strain_stiffening"], draws=19, device="cpu")
found = Diagnosis.read("found")  # also of an earlier run
print(found.answer, found.error)
found.plot().savefig("found.png")
found.report("found.html")
""",
    "effects": f"""
from neuido import Scene, Simulator, effects, laws, shapes
{_BALL}
damped = effects.Effects(drag_linear=2.0, viscosity_shear=5.0)  # 1/s and Pa s
frames = simulator.rollout(50, laws.FixedCorotated(5e4, 0.3), every=10, effects=damped)
""",
    "Encoder": """
from neuido import Encoder

encoder = Encoder.from_pretrained("pretrained-small")
print(encoder.card)
""",
    "export": f"""
import neuido
from neuido import Scene, Simulator, laws, shapes
{_BALL}
frames = simulator.rollout(50, laws.FixedCorotated(5e4, 0.3), every=10)
neuido.export(frames, "motion.npz")
neuido.export(frames, "motion.ply")  # a sequence, one file a frame
""",
    "FiniteElements": """
from neuido import FiniteElements, Scene, laws, shapes

body = shapes.ball(centre=(0.5, 0.3, 0.5), radius=0.1, spacing=0.04)
frames = FiniteElements(Scene(dt=1e-3), body, device="cpu").rollout(50, laws.NeoHookean(5e4, 0.3), every=10)
print(frames.x.shape)
""",
    "Gaussians": """
import torch

from neuido import Gaussians, render
from neuido.data import cameras

means, colours = 0.3 * torch.rand(200, 3) + 0.35, torch.rand(200, 3)
harmonics = (colours - 0.5)[:, None] / 0.28209479  # spherical harmonics of degree zero
gaussians = Gaussians(means, 1e-4 * torch.eye(3).expand(200, 3, 3), torch.full((200,), 0.9), harmonics)
images, alphas = render(gaussians, cameras.orbit(2, width=64, height=64))
""",
    "import_scene": """
from pathlib import Path

from neuido import import_scene

Path("jelly.xml").write_text('''
<mujoco><worldbody>
  <geom type="plane" size="1 1 .1"/>
  <flexcomp name="jelly" type="grid" count="5 5 5" spacing=".05 .05 .05" pos="0 0 .3" dim="3" mass="2">
    <elasticity young="5e4" poisson="0.3"/>
  </flexcomp>
</worldbody></mujoco>
''')
print(*import_scene("jelly.xml", "jelly", particles=500), sep="\\n")  # `neuido simulate jelly/scene.yaml --out run` runs it
""",
    "Keyframes": """
from neuido import Keyframes, colliders

there_and_back = Keyframes(times=(0.0, 0.5, 1.0), positions=((0.2, 0.1, 0.5), (0.8, 0.1, 0.5), (0.2, 0.1, 0.5)))  # s and m
plate = colliders.Cuboid((0.2, 0.1, 0.4), path=there_and_back)
""",
    "laws": """
import torch

from neuido import laws

young = torch.tensor([1e5], requires_grad=True)  # Pa
elastic = laws.FixedCorotated(young, 0.3)
plastic = laws.VonMises(2e3, young, 0.3)
""",
    "load_scene": """
from pathlib import Path

from neuido import load_scene

Path("my-scene.yaml").write_text('''
format: neuido-scene/1
name: my-scene
scene: {domain: [[0, 0, 0], [1, 1, 1]], gravity: [0, -9.8, 0]}
model: {density: 1000.0, elasticity: {law: sigma, young: 3.0e+5, poisson: 0.25}}
body: {shape: ball, centre: [0.5, 0.3, 0.5], radius: 0.12, spacing: 0.04}
discretisation: {grid: 24, dt: 5.0e-4}
steps: 200
''')
setup = load_scene("my-scene.yaml")
print(setup.scene, len(setup.body.x))
""",
    "OwnEffect": """
import numpy as np

from neuido import OwnEffect, diagnose

t = np.linspace(0, 0.6, 40)  # a ball dropped in a lift that begins to rise
drop = {"t": t, "y": 2.0 - 0.5 * 9.81 * t**2 - 0.4 * t**3 + 1e-3 * np.random.default_rng(0).standard_normal(40), "noise": 1e-3}
lift = OwnEffect(
    "rising_lift", "jerk", "m/s^3", start=1.0, low=-20.0, high=20.0,
    acts_as=lambda j: {"time_force.interval": 0.2, **{f"time_force.y{k}": -j * 0.2 * k for k in range(5)}},
)
found = diagnose({"drop": drop}, model={"gravity": [0.0, -9.81, 0.0]}, candidates=[lift], effects=["drag_linear"], draws=39)
print(found.summary())
""",
    "Operator": """
from neuido import Operator

operator = Operator.from_pretrained()  # the weights that come with neuido
elastic, plastic = operator.laws(operator.latent("plasticine"))  # or jelly, sand
""",
    "ParticleState": f"""
from neuido import Scene, Simulator, laws, shapes
{_BALL}
start = simulator.state  # x, v, C and F at t = 0
faster = start._replace(v=2.0 * start.v)
frames = simulator.rollout(50, laws.FixedCorotated(5e4, 0.3), every=10, state=faster)
""",
    "Plane": """
from neuido import Plane, Scene

slope = Plane(point=(0.5, 0.2, 0.5), normal=(0.5, 1.0, 0.0), contact="separate", friction=0.3)
scene = Scene(colliders=(slope,))
""",
    "rasterize": """
import torch

from neuido import rasterize
from neuido.data import cameras

around = cameras.orbit(2, width=64, height=64)
means = torch.rand(100, 3) * 0.3 + 0.35
images, alphas = rasterize(
    means, 1e-4 * torch.eye(3).expand(100, 3, 3), torch.full((100,), 0.9), torch.rand(100, 3), around.viewmats, around.Ks, 64, 64
)
""",
    "read_experiment": """
from neuido import UserError, read_experiment

try:
    experiment = read_experiment("my-experiment")  # a folder with experiment.yaml
    print(experiment.name, [recording.name for recording in experiment.of("fit")])
except UserError as error:
    print(error)
""",
    "read_law": """
from neuido import UserError, read_law

try:
    law = read_law("film/Ball", encoder="pretrained-small")  # a folder that `neuido reconstruct` has prepared
    print(law.moduli)
except UserError as error:
    print(error)
""",
    "read_material_tests": f"""
from neuido import read_material_tests
{_TEST}
tests = read_material_tests(folder)
print(tests.tests[0].path[:, 0], tests.tests[0].stress[:, 0])
""",
    "read_plane_experiment": """
from pathlib import Path

from neuido import read_plane_experiment

folder = Path("plate")
folder.mkdir(exist_ok=True)
(folder / "nodes.csv").write_text("x,y,boundary_x,boundary_y\\n0,0,left,low\\n1,0,right,low\\n1,1,right,\\n0,1,left,\\n0.5,0.5,,\\n")
(folder / "elements.csv").write_text("node1,node2,node3\\n0,1,4\\n1,2,4\\n2,3,4\\n3,0,4\\n")
(folder / "step.csv").write_text("ux,uy\\n0,0\\n0.1,0\\n0.1,-0.03\\n0,-0.03\\n0.05,-0.015\\n")
(folder / "plane.yaml").write_text('''
format: neuido-plane/1
name: plate
model: {elasticity: {law: neo_hookean, young: 1000000.0, poisson: 0.3}, free: [poisson]}
specimen: {nodes: nodes.csv, elements: elements.csv, thickness: 0.002, condition: stress}
recordings: [{name: pull, role: fit, displacements: [step.csv], noise: {displacement: 0.001}}]
''')
print(read_plane_experiment(folder).recordings[0].displacement)
""",
    "read_recording": """
from neuido import UserError, read_recording

try:
    recording = read_recording("my-video")  # images and cameras in any known layout
    print(recording.format, recording.views, recording.times)
except UserError as error:
    print(error)
""",
    "import_file": """
from pathlib import Path

from neuido import import_file

Path("throw.txt").write_text("t;x;y\\n0,0;0,0;0,0\\n0,1;0,1;0,35\\n0,2;0,2;0,60\\n0,3;0,3;0,76\\n")
for line in import_file("throw.txt", None):  # a folder in place of None is written
    print(line)
""",
    "read_tracks": """
from pathlib import Path

from neuido import read_tracks

folder = Path("ball")
folder.mkdir(exist_ok=True)
(folder / "throw.csv").write_text("t,y\\n0.0,0.0\\n0.1,0.35\\n0.2,0.60\\n0.3,0.76\\n0.4,0.82\\n")
(folder / "track.yaml").write_text('''
format: neuido-track/1
name: ball
model: {gravity: [0, -9.81, 0]}
bodies: {ball: {mass: 0.05}}
recordings: [{name: throw, body: ball, file: throw.csv, columns: {t: t, y: y}, role: fit}]
''')
print(read_tracks(folder).of("fit")[0].x)
""",
    "render": """
import torch

from neuido import render, shapes
from neuido.data import cameras
from neuido.models import attach_gaussians

body = shapes.ball(centre=(0.5, 0.5, 0.5), radius=0.2, spacing=0.05)
gaussians = attach_gaussians(body.x.float(), body.volume.float(), torch.rand(len(body.x), 3))
images, alphas = render(gaussians, cameras.orbit(1, width=64, height=64))
""",
    "Scene": """
from neuido import Scene

scene = Scene(lower=(0, 0, 0), upper=(2, 1, 1), cells=40, dt=5e-4, gravity=(0.0, -9.8, 0.0))
print(scene.dx)  # m, the edge of a cell
""",
    "shapes": """
from neuido import shapes

body = shapes.cylinder(centre=(0.5, 0.3, 0.5), radius=0.1, height=0.4, spacing=0.03, velocity=(0.0, -1.0, 0.0))
print(len(body.x))
""",
    "Simulator": """
import torch

from neuido import Scene, Simulator, laws, shapes

body = shapes.cube(length=0.2, centre=(0.5, 0.15, 0.5), particles_per_side=5, velocity=(0.0, -1.0, 0.0))
simulator = Simulator(Scene(cells=16, dt=1e-3), body, device="cpu")
young = torch.tensor([5e4], requires_grad=True)
frames = simulator.rollout(100, laws.FixedCorotated(young, 0.3), every=10)
frames.x[-1, :, 1].mean().backward()
print(young.grad)
""",
    "Skin": """
import torch

from neuido import Skin

x = torch.rand(1, 50, 3)  # one frame of 50 particles
corner = Skin(x[0, :3], torch.tensor([[0, 1, 2]]), indices=torch.tensor([[0], [1], [2]]), weights=torch.ones(3, 1))
print(corner.vertices_at(x).shape)  # one triangle between three particles
""",
    "UserError": """
from neuido import Scene, Simulator, UserError, laws, shapes

body = shapes.ball(centre=(0.5, 0.3, 0.5), radius=0.1, spacing=0.05)
try:
    Simulator(Scene(cells=64, dt=0.1), body, device="cpu").rollout(10, laws.FixedCorotated(1e6, 0.3))
except UserError as error:
    print(error)  # what was wrong, the value, and what to change
""",
    "Walls": """
from neuido import Scene, Walls

closed = Scene(walls=Walls(contact="separate", friction=0.4, inset=2.0))
open_air = Scene(walls=None)  # a particle that leaves the domain is then an error
""",
    "Frames": f"""
from neuido import Scene, Simulator, laws, shapes
{_BALL}
frames = simulator.rollout(50, laws.FixedCorotated(5e4, 0.3), every=10)
print(frames, frames.times)
frames.save("motion.npz")  # or .csv, or .ply: a point cloud a frame
""",
    "show": f"""
import neuido
from neuido import Scene, Simulator, laws, shapes
{_BALL}
frames = simulator.rollout(50, laws.FixedCorotated(5e4, 0.3), every=10)
player = neuido.show(frames, colour="speed")  # the last line of a notebook's cell plays it
player.save("drop.html")
""",
    "view": f"""
import neuido
from neuido import Scene, Simulator, laws, shapes
{_BALL}
frames = simulator.rollout(50, laws.FixedCorotated(5e4, 0.3), every=10)
page = neuido.view(frames, laws.FixedCorotated(5e4, 0.3))  # with the law also the stress can be shown
print(page.url)  # open it in a browser; page.wait() serves until Ctrl+C
page.stop()
""",
}
