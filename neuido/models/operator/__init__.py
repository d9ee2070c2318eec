"""The neural operator: latents to laws, and what the latents mean."""
