"""Figures as they come out on paper."""

from matplotlib.backends.backend_agg import FigureCanvasAgg


def cut_off(figure) -> bool:
    """Whether an axis, its numbers, a name or a title stick out of a figure."""
    box = figure.get_tightbbox(FigureCanvasAgg(figure).get_renderer())
    width, height = figure.get_size_inches()
    return min(box.x0, box.y0, width - box.x1, height - box.y1) < 0
