"""A page in the browser, beside a run or of its results."""

PORT = 8080
"""Where a page is served, unless another program is there already."""
