// What all figures share: drawn anew when their width changes; a plane in metres to move and zoom.
pcm.redrawn = (host, draw) => {
  let width = 0;
  const look = () => {
    const now = Math.floor(host.clientWidth);
    if (now > 0 && now !== width) {
      width = now;
      draw(width);
    }
  };
  new ResizeObserver(look).observe(host);
  look();
};

// An empty drawing in place of what a host had.
pcm.drawing = (host, width, height, label) =>
  d3
    .select(host)
    .html("")
    .append("svg")
    .attr("width", width)
    .attr("height", height)
    .attr("viewBox", `0 0 ${width} ${height}`)
    .attr("role", "img")
    .attr("aria-label", label);

// The names of a drawing's axes, at their far ends.
pcm.nameAxes = (svg, [across, up], margin, width, height) => {
  svg.append("text").attr("class", "axis-name").attr("x", width - margin.right).attr("y", height - 4).attr("text-anchor", "end").text(across);
  svg.append("text").attr("class", "axis-name").attr("transform", `translate(11,${margin.top}) rotate(-90)`).attr("text-anchor", "end").text(up);
};

// A colour of the style sheet as it is in the theme that is seen.
pcm.colour = (() => {
  const probe = document.createElement("span");
  probe.hidden = true;
  document.body.append(probe);
  return (name) => {
    probe.style.color = `var(${name})`;
    return getComputedStyle(probe).color;
  };
})();

// The most that a map of this width may be high.
pcm.tallest = (width) => Math.max(280, Math.min(560, 1.1 * width));

pcm.button = (text, label, action) => {
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = text;
  button.setAttribute("aria-label", label);
  button.addEventListener("click", action);
  return button;
};

// A plane of metres, both axes of one scale. `box` is [[x0, y0], [x1, y1]]; `layers` draws with the
// scales as they are without zoom, `labels` again whenever the view moves.
pcm.plane = (host, { label, box, axes, width, names }) => {
  const margin = axes ? { top: 8, right: 8, bottom: 38, left: 52 } : { top: 8, right: 8, bottom: 30, left: 8 };
  const [[x0, y0], [x1, y1]] = box;
  const spread = Math.max(x1 - x0, y1 - y0, 1e-9);
  const dx = Math.max(x1 - x0, 0.3 * spread) * 1.06;
  const dy = Math.max(y1 - y0, 0.3 * spread) * 1.06;
  const inner = width - margin.left - margin.right;
  const high = Math.min(Math.max((inner * dy) / dx, 150), pcm.tallest(inner));
  const perMetre = Math.min(inner / dx, high / dy);
  const height = high + margin.top + margin.bottom;
  const middle = [(x0 + x1) / 2, (y0 + y1) / 2];
  const x = d3
    .scaleLinear()
    .domain([middle[0] - inner / perMetre / 2, middle[0] + inner / perMetre / 2])
    .range([margin.left, width - margin.right]);
  const y = d3
    .scaleLinear()
    .domain([middle[1] - high / perMetre / 2, middle[1] + high / perMetre / 2])
    .range([height - margin.bottom, margin.top]);

  const svg = pcm.drawing(host, width, height, label);
  const clip = `clip-${(pcm.clips = (pcm.clips || 0) + 1)}`;
  svg
    .append("clipPath")
    .attr("id", clip)
    .append("rect")
    .attr("x", margin.left)
    .attr("y", margin.top)
    .attr("width", inner)
    .attr("height", high);
  const bottom = axes && svg.append("g").attr("class", "axis").attr("transform", `translate(0,${height - margin.bottom})`);
  const left = axes && svg.append("g").attr("class", "axis").attr("transform", `translate(${margin.left},0)`);
  const frame = svg.append("g").attr("clip-path", `url(#${clip})`);
  const scene = frame.append("g").attr("class", "scene");
  const over = frame.append("g");
  if (axes) pcm.nameAxes(svg, names.map((name) => `${name} (m)`), margin, width, height);
  const bar = svg.append("g").attr("class", "scale-bar");

  const view = { x, y, scene, over, svg, height, transform: d3.zoomIdentity, onMove: () => {} };
  const moved = () => {
    const t = view.transform;
    scene.attr("transform", t);
    const [nx, ny] = [t.rescaleX(x), t.rescaleY(y)];
    view.px = (point) => [nx(point[0]), ny(point[1])];
    if (axes) {
      bottom.call(d3.axisBottom(nx).ticks(Math.max(2, inner / 90)).tickSizeInner(-high).tickPadding(6));
      left.call(d3.axisLeft(ny).ticks(Math.max(2, high / 60)).tickSizeInner(-inner).tickPadding(6));
    } else {
      const metres = niceLength((0.22 * inner) / (perMetre * t.k));
      const pixels = metres * perMetre * t.k;
      const [bx, by] = [width - 14 - pixels, height - 8];
      bar.selectAll("*").remove();
      bar.append("path").attr("d", `M${bx},${by - 5}v5h${pixels}v-5`);
      bar.append("text").attr("x", bx + pixels / 2).attr("y", by - 8).attr("text-anchor", "middle").text(`${d3.format(",~g")(metres)} m`);
    }
    view.onMove();
  };
  const zoom = d3
    .zoom()
    .scaleExtent([1, 80])
    .extent([[0, 0], [width, height]])
    .translateExtent([[0, 0], [width, height]])
    .filter((event) => {
      if (event.type === "wheel") return event.ctrlKey || event.metaKey;
      return event.touches ? event.touches.length > 1 : !event.button;
    })
    .clickDistance(4)
    .on("zoom", (event) => {
      view.transform = event.transform;
      moved();
    });
  svg.call(zoom).on("dblclick.zoom", null);
  const head = host.closest("figure").querySelector("figcaption");
  head.querySelectorAll(".zoom").forEach((old) => old.remove());
  const controls = document.createElement("div");
  controls.className = "zoom";
  controls.append(
    pcm.button("+", "Zoom in", () => svg.call(zoom.scaleBy, 1.6)),
    pcm.button("−", "Zoom out", () => svg.call(zoom.scaleBy, 1 / 1.6)),
    pcm.button("⤢", "Show all", () => svg.call(zoom.transform, d3.zoomIdentity)),
  );
  head.prepend(controls);
  view.start = moved;
  moved();
  return view;
};

function niceLength(most) {
  const power = 10 ** Math.floor(Math.log10(most));
  return [5, 2, 1].map((k) => k * power).find((length) => length <= most) || power;
}
