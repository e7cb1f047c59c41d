"""Transport schemes: how radiance moves from plane to plane."""
