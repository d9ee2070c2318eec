"""
A rubber test
=============

Which effect does a neo-Hookean model of rubber lack? The diagnosis needs a CSV file of a tensile test and a short YAML file. This
example writes both itself, from a Gent solid with noise. So the right answer is known: strain stiffening.
Run it with ``python examples/07_rubber_test.py``.
"""

from pathlib import Path

import numpy as np

from neuido import diagnose

folder = Path("rubber")
folder.mkdir(exist_ok=True)
stretch = np.linspace(1.0, 3.2, 23)
gent = 4e5 / (1 - 0.06 * (stretch**2 + 2 / stretch - 3)) * (stretch - stretch**-2)  # Pa, nominal
measured = gent + 5e3 * np.random.default_rng(0).standard_normal(len(stretch))
np.savetxt(folder / "tensile.csv", np.c_[stretch, measured / 1e6], delimiter=",", header="Stretch,Stress", comments="")
(folder / "test.yaml").write_text("""\
format: neuido-material-test/1
name: rubber
model:
  density: 930.0
  elasticity: {law: neo_hookean, young: 1.2e6, poisson: 0.499}
  plasticity: {law: identity}
  free: [young]
  incompressible: true
tests:
  - {name: small, file: tensile.csv, mode: uniaxial, columns: {stretch: Stretch, nominal_stress: Stress},
     scale: {nominal_stress: 1.0e6}, rows: [0, 16], role: fit}
  - {name: large, file: tensile.csv, mode: uniaxial, columns: {stretch: Stretch, nominal_stress: Stress},
     scale: {nominal_stress: 1.0e6}, rows: [16, 23], role: held_out}
""")

# %%
# The model is fitted to the rows up to a stretch of 2.5. It must predict those above.
diagnosis = diagnose(folder, out="rubber-diagnosis", effects="strain_stiffening,second_invariant,yield", draws=39, device="cpu")
print(diagnosis.summary())

# %%
figure = diagnosis.plot()
figure.savefig("rubber.png", dpi=110)
