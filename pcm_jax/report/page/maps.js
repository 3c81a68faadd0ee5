// Maps with closures: before, after, by the rival, and with the anchors' ellipses.
(() => {
  const { data, state } = pcm;
  const unit = data.unit;
  const FATES = ["rejected", "rival", "refused", "accepted"];

  const points = (columns) => {
    const [u, v] = pcm.axes();
    return columns[u].map((value, k) => [value * unit, columns[v][k] * unit]);
  };
  const boxOf = (clouds) => {
    const all = clouds.flat();
    const [xs, ys] = [0, 1].map((axis) => d3.extent(all, (point) => point[axis]));
    return [[xs[0], ys[0]], [xs[1], ys[1]]];
  };
  const shifted = (cloud, by) => cloud.map((point) => [point[0] + by[0], point[1] + by[1]]);

  // Where the robots' own maps lie side by side: as many columns as make them largest.
  function sideBySide(boxes, aspect) {
    const sizes = boxes.map(([low, high]) => [high[0] - low[0], high[1] - low[1]]);
    const widest = d3.max(sizes, (size) => size[0]) || 1;
    const tallest = d3.max(sizes, (size) => size[1]) || 1;
    const gap = 0.12 * Math.max(widest, tallest);
    const [w, h] = [Math.max(widest, 0.2 * tallest) + gap, Math.max(tallest, 0.2 * widest) + gap];
    const scale = (columns) => Math.min(aspect / (columns * w), 1 / (Math.ceil(sizes.length / columns) * h));
    const columns = d3.greatest(d3.range(1, sizes.length + 1), scale);
    return boxes.map(([low, high], robot) => [
      (robot % columns) * w - (low[0] + high[0]) / 2,
      -Math.floor(robot / columns) * h - (low[1] + high[1]) / 2,
    ]);
  }

  // The clouds of robots and the ends of closures that a figure shows.
  function before(width) {
    const own = data.robots.map((robot) => points(robot.own));
    const shifts = sideBySide(own.map((cloud) => boxOf([cloud])), width / pcm.tallest(width));
    const ends = ["a", "b"].map((end) => {
      const cloud = points(data.closures[`own_${end}`]);
      return cloud.map((point, k) => {
        const by = shifts[data.closures[end][k]];
        return [point[0] + by[0], point[1] + by[1]];
      });
    });
    const clouds = own.map((cloud, robot) => ({ robot, cloud: shifted(cloud, shifts[robot]) }));
    return { clouds, ends, closures: d3.range(pcm.count) };
  }

  function after(group) {
    const inside = new Set(data.groups[group]);
    const clouds = [...inside].map((robot) => ({ robot, cloud: points(data.robots[robot].merged) }));
    const closures = d3
      .range(pcm.count)
      .filter((k) => inside.has(data.closures.a[k]) && inside.has(data.closures.b[k]));
    return {
      clouds,
      ends: ["a", "b"].map((end) => points(data.closures[`merged_${end}`])),
      claimed: points(data.closures.claimed),
      closures,
    };
  }

  function aligned(index, by) {
    const pair = data.pairs[index];
    const alignment = pair.alignments[by];
    const moved = (columns) => {
      const space = columns.length;
      const rows = d3.range(space).map((i) =>
        columns[0].map((_, k) => {
          const sum = d3.sum(d3.range(space), (j) => alignment[i][j] * columns[j][k]);
          return sum + alignment[i][space] / unit;
        }),
      );
      return points(rows);
    };
    const { a, b, own_a: ownA, own_b: ownB } = data.closures;
    const [plainA, plainB, movedA, movedB] = [points(ownA), points(ownB), moved(ownA), moved(ownB)];
    return {
      clouds: [
        { robot: pair.a, cloud: points(data.robots[pair.a].own) },
        { robot: pair.b, cloud: moved(data.robots[pair.b].own) },
      ],
      ends: [
        plainA.map((point, k) => (a[k] === pair.b ? movedA[k] : point)),
        plainB.map((point, k) => (b[k] === pair.b ? movedB[k] : point)),
      ],
      aside: by === "rival" ? (pair.accepted ? "accepted" : "refused") : "rival",
      closures: pair.closures.filter((_, at) => pair.isRival.has(at) || pair.isMember.has(at)),
    };
  }

  const line = (scales) => d3.line((p) => scales.x(p[0]), (p) => scales.y(p[1]));
  const segments = (view, shown, closures) =>
    closures
      .map((k) => {
        const [p, q] = [shown.ends[0][k], shown.ends[1][k]];
        return `M${view.x(p[0])},${view.y(p[1])}L${view.x(q[0])},${view.y(q[1])}`;
      })
      .join("");
  // Dots as strokes of no length, which keep their size when the view is zoomed.
  const dots = (view, shown, closures) =>
    closures
      .flatMap((k) => [shown.ends[0][k], shown.ends[1][k]])
      .map((p) => `M${view.x(p[0])},${view.y(p[1])}h0`)
      .join("");

  function drawClosures(view, shown) {
    const group = view.scene.select("g.closures");
    group.selectAll("*").remove();
    const most = shown.closures.length;
    FATES.filter((fate) => !state.hidden.has(fate)).forEach((fate) => {
      const some = shown.closures.filter((k) => data.closures.fate[k] === fate);
      if (!some.length) return;
      const aside = fate === "rejected" || shown.aside === fate;
      const faint = aside ? Math.max(0.15, Math.min(0.8, 60 / most)) : Math.max(0.4, Math.min(1, 150 / some.length));
      group.append("path").attr("class", `closure ${fate}`).attr("opacity", faint).attr("d", segments(view, shown, some));
      if (fate === "rejected") return;
      const thick = Math.max(2.5, Math.min(6, 6 * Math.sqrt(100 / some.length)));
      group.append("path").attr("class", `ends ${fate}`).attr("stroke-width", thick).attr("d", dots(view, shown, some));
    });
  }

  function drawPicked(view, shown) {
    const group = view.scene.select("g.picked");
    group.selectAll("*").remove();
    view.claim = null;
    const k = state.picked;
    if (k === null || !shown.closures.includes(k)) return;
    const relations = pcm.relations(k);
    if (relations && relations.ofSet) {
      const against = relations.contradicts.filter((other) => shown.closures.includes(other));
      group.append("path").attr("class", "conflict-casing").attr("d", segments(view, shown, against));
      group.append("path").attr("class", "conflict").attr("d", segments(view, shown, against));
    }
    group.append("path").attr("class", "picked-casing").attr("d", segments(view, shown, [k]));
    group.append("path").attr("class", "picked-line").attr("d", segments(view, shown, [k]));
    group.append("path").attr("class", "picked-ends").attr("d", dots(view, shown, [k]));
    if (shown.claimed) {
      const [from, to, claim] = [shown.ends[0][k], shown.ends[1][k], shown.claimed[k]];
      group.append("path").attr("class", "claim").attr("d", line(view)([from, claim, to]));
      view.claim = claim;
    }
  }

  function drawLabels(view, shown) {
    view.over.selectAll("*").remove();
    const labels = [];
    shown.clouds.forEach(({ robot, cloud }) => {
      const [x, y] = view.px(cloud[0]);
      let height = Math.max(y - 7, 22);
      while (labels.some(([u, v]) => Math.abs(u - x) < 60 && Math.abs(v - height) < 15)) height += 15;
      labels.push([x, height]);
      view.over.append("circle").attr("class", `start robot-${robot % 4}`).attr("cx", x).attr("cy", y).attr("r", 4.5);
      const right = x > 0.7 * view.svg.attr("width");
      view.over.append("text").attr("class", "robot-name").attr("x", x + (right ? -9 : 9)).attr("y", height).attr("text-anchor", right ? "end" : "start").text(data.robots[robot].name);
    });
    if (view.claim) {
      const [x, y] = view.px(view.claim);
      view.over.append("path").attr("class", "claim-mark").attr("d", `M${x},${y - 7}l7,7l-7,7l-7,-7z`);
    }
    const k = state.picked;
    if (k !== null && shown.closures.includes(k)) {
      const middle = [0, 1].map((axis) => (shown.ends[0][k][axis] + shown.ends[1][k][axis]) / 2);
      const [x, y] = view.px(middle);
      view.over.append("text").attr("class", "picked-name").attr("x", x + 6).attr("y", y - 6).text(k);
    }
  }

  // The closure nearest to the pointer, at most 12 pixels away.
  function nearest(view, shown, pointer) {
    const visible = shown.closures.filter((k) => !state.hidden.has(data.closures.fate[k]));
    const rank = { accepted: -2, refused: -1, rival: -1, rejected: 0 };
    const away = (k) => {
      const [p, q] = [view.px(shown.ends[0][k]), view.px(shown.ends[1][k])];
      const along = [q[0] - p[0], q[1] - p[1]];
      const length = along[0] ** 2 + along[1] ** 2 || 1;
      const t = Math.max(0, Math.min(1, ((pointer[0] - p[0]) * along[0] + (pointer[1] - p[1]) * along[1]) / length));
      return Math.hypot(p[0] + t * along[0] - pointer[0], p[1] + t * along[1] - pointer[1]) + rank[data.closures.fate[k]];
    };
    const found = d3.least(visible, away);
    return found !== undefined && away(found) <= 12 ? found : null;
  }

  function ellipses(view, group) {
    const tied = data.anchors.filter((anchor) => anchor && data.groups[group].includes(anchor.robot));
    const axes = pcm.axes();
    const shapes = tied.map((anchor) => {
      const [[a, b], [, c]] = axes.map((i) => axes.map((j) => anchor.covariance[i][j]));
      const [half, root] = [(a + c) / 2, Math.hypot((a - c) / 2, b)];
      return {
        at: axes.map((axis) => anchor.middle[axis] * unit),
        radii: [half + root, Math.max(half - root, 0)].map((v) => Math.sqrt(v * anchor.scale)),
        turn: Math.atan2(2 * b, a - c) / 2,
        name: data.robots[anchor.robot].name,
        robot: anchor.robot,
      };
    });
    const pixels = Math.abs(view.x(1) - view.x(0));
    const largest = d3.max(shapes, (shape) => shape.radii[0]) || 1;
    const times = Math.max(1, 10 ** Math.floor(Math.log10(60 / (largest * pixels))));
    const layer = view.scene.append("g");
    shapes.forEach((shape) => {
      const [x, y] = [view.x(shape.at[0]), view.y(shape.at[1])];
      layer
        .append("ellipse")
        .attr("class", `ellipse robot-${shape.robot % 4}`)
        .attr("rx", Math.max(shape.radii[0] * pixels * times, 1))
        .attr("ry", Math.max(shape.radii[1] * pixels * times, 1))
        .attr("transform", `translate(${x},${y}) rotate(${(-shape.turn * 180) / Math.PI})`);
    });
    const told = shapes.map((shape) => `${shape.name}: ${shape.radii.map((r) => d3.format(".2~g")(r)).join(" by ")} m`);
    const drawn = times > 1 ? `, drawn ${times} times as large` : "";
    return `Half axes of the 95 % ellipse${drawn}. ${told.join("; ")}.`;
  }

  function figure(host) {
    const kind = host.dataset.draw;
    const title = host.closest("figure").querySelector("h3").textContent;
    const index = Number(host.dataset.group || host.dataset.pair || 0);
    let view, shown;
    const build = (width) => {
      shown = { before: () => before(width), after: () => after(index), rival: () => aligned(index, host.dataset.by), anchors: () => after(index) }[kind]();
      const robots = shown.clouds.map(({ robot }) => data.robots[robot].name).join(" and ");
      view = pcm.plane(host, {
        label: `${title}: map of ${robots}${kind === "anchors" ? "" : `, ${shown.closures.length} closures`}. The table below lists every closure.`,
        box: boxOf(shown.clouds.map(({ cloud }) => cloud)),
        axes: kind !== "before",
        names: [...state.plane],
        width,
      });
      const maps = view.scene.append("g");
      shown.clouds.forEach(({ robot, cloud }) => {
        maps.append("path").attr("class", `robot robot-${robot % 4} dash-${Math.floor(robot / 4) % 3}`).attr("d", line(view)(cloud));
      });
      if (kind === "anchors") {
        host.closest("figure").querySelector(".scale-note").textContent = ellipses(view, index);
      } else {
        view.scene.append("g").attr("class", "closures");
        view.scene.append("g").attr("class", "picked");
        drawClosures(view, shown);
        drawPicked(view, shown);
        listen();
      }
      view.onMove = () => drawLabels(view, shown);
      view.start();
    };
    const listen = () => {
      const hover = view.svg.append("text").attr("class", "hover").attr("aria-hidden", "true");
      view.svg
        .on("click", (event) => {
          const found = nearest(view, shown, d3.pointer(event, view.svg.node()));
          if (found !== null) pcm.pick(found);
        })
        .on("pointermove", (event) => {
          const at = d3.pointer(event, view.svg.node());
          const found = event.pointerType === "mouse" && !event.buttons ? nearest(view, shown, at) : null;
          view.svg.classed("pointing", found !== null);
          hover
            .attr("x", at[0] + (at[0] > 0.7 * view.svg.attr("width") ? -12 : 12))
            .attr("y", at[1] - 10)
            .attr("text-anchor", at[0] > 0.7 * view.svg.attr("width") ? "end" : "start")
            .text(found === null ? "" : `closure ${found}, ${data.closures.fate[found]}`);
        })
        .on("pointerleave", () => hover.text(""));
    };
    pcm.redrawn(host, build);
    pcm.on("plane", () => host.clientWidth && build(Math.floor(host.clientWidth)));
    if (kind === "anchors") return;
    pcm.on("hidden", () => drawClosures(view, shown));
    pcm.on("pick", () => {
      drawPicked(view, shown);
      drawLabels(view, shown);
    });
  }

  function legend() {
    const host = document.getElementById("legend");
    [...FATES].reverse().forEach((fate) => {
      const many = data.closures.fate.filter((one) => one === fate).length;
      if (!many) return;
      const label = document.createElement("label");
      const box = document.createElement("input");
      box.type = "checkbox";
      box.checked = true;
      box.dataset.fate = fate;
      box.addEventListener("change", () => pcm.toggle(fate, box.checked));
      label.append(box, swatch(`closure ${fate}`, fate === "rejected" ? "" : `ends ${fate}`), `${fate} (${many})`);
      host.append(label);
    });
    const key = (mark, text) => {
      const entry = document.createElement("span");
      entry.append(mark, text);
      host.append(entry);
    };
    data.robots.forEach((robot, k) => key(swatch(`robot robot-${k % 4} dash-${Math.floor(k / 4) % 3}`), robot.name));
    if (data.pairs.length) key(swatch("conflict"), "contradicts the picked one");
    if (document.querySelector("[data-draw=after]")) key(swatch("", "", "claim-mark"), "where the picked one puts its pose");
  }

  function swatch(lineClass, endsClass, markClass) {
    const svg = d3.create("svg").attr("class", "swatch").attr("width", 34).attr("height", 14).attr("aria-hidden", "true");
    if (lineClass) svg.append("path").attr("class", lineClass).attr("d", "M3,7H31");
    if (endsClass) svg.append("path").attr("class", endsClass).attr("d", "M4,7h0M30,7h0");
    if (markClass) svg.append("path").attr("class", markClass).attr("d", "M17,1l6,6l-6,6l-6,-6z");
    return svg.node();
  }

  pcm.startMaps = () => {
    legend();
    document.querySelectorAll("[data-draw=before],[data-draw=after],[data-draw=rival],[data-draw=anchors]").forEach(figure);
    const plane = document.getElementById("plane");
    if (plane) plane.addEventListener("change", () => pcm.choosePlane(plane.value));
  };
})();
