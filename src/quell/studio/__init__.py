"""The studio: a page in the browser that simulates and analyses a setup while sliders move.

``page`` has the page itself: HTML, style and scripts, which the server sends as they are, and uPlot
with its licence. May import every folder below; only ``cli`` imports this one.
"""
