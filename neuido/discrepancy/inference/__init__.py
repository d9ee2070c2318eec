"""What inference stands on: fits and their floors, what noise and chance do, the records kept of them, and their evidence."""
