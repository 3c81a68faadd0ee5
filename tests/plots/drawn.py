"""What a picture shows: its legend's texts, and a line by its label."""


def legend_of(owner):
    legend = owner.get_legend() if hasattr(owner, "get_legend") else owner.legends[0]
    return [text.get_text() for text in legend.get_texts()]


def line(ax, label):
    (found,) = [x for x in ax.get_lines() if str(x.get_label()).startswith(label)]
    return found
