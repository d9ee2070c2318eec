"""From video to latents: optical flow, flow VAE and encoder."""
