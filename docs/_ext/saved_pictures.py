"""Show the PNG files that an example saves, in the gallery."""

import shutil
from pathlib import Path


class SavedPictures:
    """Show the PNG files that a block of an example saved."""

    def __init__(self):
        self.seen = set()

    def __repr__(self):
        return "SavedPictures"

    def __call__(self, block, block_vars, gallery_conf):
        from sphinx_gallery.scrapers import figure_rst

        shown = []
        for path in sorted(Path(block_vars["src_file"]).parent.glob("*.png")):
            if path not in self.seen:
                self.seen.add(path)
                target = next(block_vars["image_path_iterator"])
                shutil.copyfile(path, target)
                shown.append(target)
        return figure_rst(shown, gallery_conf["src_dir"])
