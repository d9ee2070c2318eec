"""Film a small ball from eight sides, and read its material law from the video in one pass."""

import subprocess
import sys

import neuido

for command in ("scenes --config small_ball --out film", "reconstruct film/Ball --steps 100 --start 800 --gaussians 800 --particles 600"):
    subprocess.run([sys.executable, "-m", "neuido", *command.split(), "--device", "cpu", "--progress", "false"], check=True)
law = neuido.read_law("film/Ball", encoder="pretrained-small", device="cpu")
law.save("law.safetensors")
print(law)
