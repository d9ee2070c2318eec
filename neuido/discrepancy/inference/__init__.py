"""Fits of a model to recordings, their error floors, tests against chance, the stored records of them, and their model evidence."""
