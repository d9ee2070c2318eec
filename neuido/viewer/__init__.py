"""Looking at motions: an interactive page (viser), pictures and videos without a display, and a player for notebooks."""
