"""Tables, values and goals of the pages, declared for the renderer, and plots; most files have the name of a page."""
