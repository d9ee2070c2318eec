"""
A law from a video
==================

A small ball is filmed from eight sides. Its first frame is reconstructed, and an encoder reads the law from the video in one pass. The
encoder is the small one that comes with neuido. Run it with ``python examples/10_law_from_video.py``: two to three minutes on a CPU.
"""

import json
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt


def run(command):
    """Run a command of neuido in this folder."""
    print("$ neuido", command)
    subprocess.run([sys.executable, "-m", "neuido", *command.split()], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


# %%
# The scene comes with neuido. Its film is a folder of images and cameras; the true motion lies beside them.
run("scenes --config small_ball --out film --device cpu")
run("reconstruct film/Ball --steps 200 --start 800 --gaussians 1500 --particles 1500 --device cpu")
run("predict --config predict.yaml --model.init_from pretrained-small --model.out law --data.root film --data.scenes [Ball]")

# %%
# The law is a file that a rollout reads. The true modulus is 30 kPa. The small encoder was trained on a few hundred clips of small
# pictures, so its modulus may be wrong by a factor of about two. From Python the same law is
# ``neuido.models.read_law("film/Ball", encoder="pretrained-small")``.
law = json.loads(Path("law/Ball/law.json").read_text())
print(f"Young's modulus read from the video: {law['young'] / 1e3:.0f} kPa, Poisson's ratio {law['poisson']:.2f}")

# %%
# Recorded frames above, predicted frames below.
sheet = plt.imread(next(Path("law/Ball").glob("*.png")))
plt.figure(figsize=(9, 9 * sheet.shape[0] / sheet.shape[1]))
plt.imshow(sheet)
plt.axis("off")
plt.tight_layout()
plt.savefig("law_from_video.png")
