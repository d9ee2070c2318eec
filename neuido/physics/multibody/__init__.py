"""Several bodies in one scene: their particles in common arrays, and the contact between them."""
