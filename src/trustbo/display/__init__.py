"""Display of objects: text in a terminal, HTML in a notebook."""
