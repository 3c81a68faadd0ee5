// Distances between closures as a matrix, and the graph of those that agree.
(() => {
  const { data, state } = pcm;
  const BAR = 16;
  const MOST_LINKS = 4000;
  const MOST_DRAWN = 15000;
  const TICKS = 200;

  function matrix(host) {
    let canvas, order, cell, size, picture;
    const readout = document.createElement("p");
    readout.className = "readout";
    readout.setAttribute("role", "status");
    const controls = document.createElement("div");
    controls.className = "controls";
    const chooser = document.createElement("select");
    [["place", "by place"], ["accepted", "accepted first"]].forEach(([value, text]) => {
      const option = document.createElement("option");
      [option.value, option.textContent] = [value, text];
      chooser.append(option);
    });
    const label = document.createElement("label");
    const name = document.createElement("span");
    name.textContent = "Order";
    label.append(name, chooser);
    controls.append(label);
    const drawn = document.createElement("p");
    drawn.className = "status thinned";
    controls.append(drawn);
    host.before(controls);
    host.after(readout);

    function ordered(pair) {
      const rank = (k) => (pair.isMember.has(k) ? 0 : pair.isRival.has(k) ? 1 : 2);
      const all = d3.range(pair.closures.length);
      return chooser.value === "place" ? all : d3.sort(all, rank);
    }

    // The picture of all distances takes long to paint, so it is kept until what it shows changes.
    function repaint() {
      const pair = data.pairs[state.pair];
      order = ordered(pair);
      picture = image(pair, pair.closures.length);
      drawn.textContent = pcm.thinned(pair);
      draw(Math.floor(host.clientWidth));
    }

    function draw(width) {
      const pair = data.pairs[state.pair];
      const n = pair.closures.length;
      size = Math.min(width, 620) - BAR;
      cell = size / n;
      const ratio = window.devicePixelRatio || 1;
      host.replaceChildren();
      canvas = document.createElement("canvas");
      canvas.width = canvas.height = Math.round((size + BAR) * ratio);
      const px = size + BAR;
      canvas.style.width = canvas.style.height = `${px}px`;
      canvas.setAttribute("role", "img");
      canvas.setAttribute("aria-label", `Distances between ${n} closures; ${pair.members.length} of them ${pair.accepted ? "are accepted" : "were found to agree and refused"}. The table of closures has the numbers.`);
      host.append(canvas);
      const context = canvas.getContext("2d");
      context.scale(ratio, ratio);
      context.imageSmoothingEnabled = false;
      context.drawImage(picture, BAR, BAR, size, size);
      bars(context, pair);
      mark(context, pair);
      canvas.addEventListener("click", (event) => {
        const [i, j] = [event.offsetY, event.offsetX].map((at) => Math.floor((at - BAR) / cell));
        if (i < 0 || j < 0 || i >= n || j >= n) return;
        pcm.pick(pair.closures[order[i]]);
        readout.textContent = told(pair, order[i], order[j]);
      });
      canvas.addEventListener("pointermove", (event) => {
        const [i, j] = [event.offsetY, event.offsetX].map((at) => Math.floor((at - BAR) / cell));
        if (i >= 0 && j >= 0 && i < n && j < n) canvas.title = told(pair, order[i], order[j]);
      });
    }

    function told(pair, i, j) {
      const [u, v] = [pair.closures[i], pair.closures[j]];
      if (i === j) return `Closure ${u}, ${data.closures.fate[u]}`;
      const word = pair.agree(i, j) ? "agree" : "contradict each other";
      const by = pair.measured ? `: ${d3.format(".2~g")(pair.times(i, j))} times what may be` : "";
      return `Closures ${u} and ${v} ${word}${by}`;
    }

    function image(pair, n) {
      const small = document.createElement("canvas");
      small.width = small.height = n;
      const context = small.getContext("2d");
      const pixels = context.createImageData(n, n);
      const within = d3.interpolateRgb(pcm.colour("--near"), pcm.colour("--near-limit"));
      const beyond = d3.interpolateRgb(pcm.colour("--far-limit"), pcm.colour("--far"));
      const bytes = new DataView(new ArrayBuffer(4));
      const table = d3.range(256).map((level) => {
        const { r, g, b } = d3.rgb(level < 128 ? within(level / 127) : beyond(Math.min((level - 128) / 80, 1)));
        [r, g, b, 255].forEach((value, k) => bytes.setUint8(k, value));
        return new Uint32Array(bytes.buffer)[0];
      });
      const filled = new Uint32Array(pixels.data.buffer);
      for (let i = 0; i < n; i += 1) {
        for (let j = 0; j < n; j += 1) filled[i * n + j] = table[pair.level(order[i], order[j])];
      }
      context.putImageData(pixels, 0, 0);
      return small;
    }

    function bars(context, pair) {
      const [ofSet, ofRival] = [pcm.colour("--accepted"), pcm.colour("--rival")];
      order.forEach((k, at) => {
        const member = pair.isMember.has(k);
        if (!member && !pair.isRival.has(k)) return;
        context.fillStyle = member ? ofSet : ofRival;
        context.globalAlpha = member && !pair.accepted ? 0.55 : 1;
        const [start, length] = [BAR + at * cell, Math.max(cell, 1)];
        const strips = member ? [[2, 12]] : [[2, 4], [10, 4]];
        strips.forEach(([offset, thick]) => {
          context.fillRect(offset, start, thick, length);
          context.fillRect(start, offset, length, thick);
        });
        context.globalAlpha = 1;
      });
    }

    function mark(context, pair) {
      const at = state.picked === null ? -1 : order.indexOf(pair.place.get(state.picked));
      if (at < 0) return;
      [[pcm.colour("--paper"), 4], [pcm.colour("--ink"), 2]].forEach(([colour, thick]) => {
        context.strokeStyle = colour;
        context.lineWidth = thick;
        context.strokeRect(BAR, BAR + at * cell, size, Math.max(cell, 2));
      });
    }

    repaint();
    pcm.redrawn(host, draw);
    chooser.addEventListener("change", repaint);
    ["pair", "theme"].forEach((event) => pcm.on(event, repaint));
    pcm.on("pick", () => draw(Math.floor(host.clientWidth)));
    pcm.on("pair", () => (readout.textContent = ""));
  }

  function graph(host) {
    const layouts = new Map();
    let nodes = [];
    let scale = null;
    let over = null;

    function layout(index) {
      if (layouts.has(index)) return layouts.get(index);
      const pair = data.pairs[index];
      const links = [];
      const n = pair.closures.length;
      for (let i = 0; i < n; i += 1) {
        for (let j = i + 1; j < n; j += 1) if (pair.agree(i, j)) links.push([i, j]);
      }
      const degree = new Array(n).fill(0);
      links.forEach((ends) => ends.forEach((k) => (degree[k] += 1)));
      const shown = d3.range(n).filter((k) => degree[k] > 0);
      const at = new Map(shown.map((k, row) => [k, row]));
      const dots = shown.map((k) => ({ k, closure: pair.closures[k] }));
      const every = Math.ceil(links.length / MOST_LINKS) || 1;
      const pulling = links.filter((_, k) => k % every === 0).map(([i, j]) => ({ source: at.get(i), target: at.get(j) }));
      const forces = d3
        .forceSimulation(dots)
        .force("links", d3.forceLink(pulling).distance(26))
        .force("apart", d3.forceManyBody().strength(-45).distanceMax(350))
        .force("x", d3.forceX().strength(0.06))
        .force("y", d3.forceY().strength(0.08))
        .force("room", d3.forceCollide(6))
        .stop();
      forces.tick(TICKS);
      const found = { dots, links, at, alone: n - shown.length };
      layouts.set(index, found);
      return found;
    }

    function draw(width) {
      const pair = data.pairs[state.pair];
      const found = layout(state.pair);
      const height = Math.min(Math.max(260, 0.8 * width), 520);
      nodes = found.dots;
      const svg = pcm.drawing(host, width, height, `Graph of ${nodes.length} closures and ${found.links.length} pairs that agree; ${found.alone} closures agree with no other.`);
      const note = svg.append("text").attr("class", "axis-name").attr("x", 6).attr("y", height - 6);
      const many = (count, one, several) => `${count} ${count === 1 ? one : several}`;
      note.text(`${many(found.links.length, "pair agrees", "pairs agree")}; ${many(found.alone, "closure agrees", "closures agree")} with no other${pair.left_out ? `; ${pcm.thinned(pair)}` : ""}`);
      if (!nodes.length) return;
      const fit = (axis, low, high) => {
        const [a, b] = d3.extent(nodes, (node) => node[axis]);
        return d3.scaleLinear().domain(a === b ? [a - 1, b + 1] : [a, b]).range([low, high]);
      };
      const [x, y] = [fit("x", 18, width - 18), fit("y", 18, height - 34)];
      scale = (node) => [x(node.x), y(node.y)];
      const kind = (ends) =>
        ends.every((k) => pair.isMember.has(k)) ? (pair.accepted ? "accepted" : "refused") : ends.every((k) => pair.isRival.has(k)) ? "rival" : "other";
      const kinds = d3.group(found.links, kind);
      ["other", "rival", "refused", "accepted"].forEach((one) => {
        const links = kinds.get(one) || [];
        const every = Math.ceil(links.length / MOST_DRAWN) || 1;
        const path = links.filter((_, k) => k % every === 0).map((ends) => {
          const [p, q] = ends.map((k) => scale(nodes[found.at.get(k)]));
          return `M${p}L${q}`;
        });
        const faint = Math.max(0.12, Math.min(0.8, 120 / Math.max(path.length, 1)));
        svg.append("path").attr("class", `link ${one}`).attr("opacity", faint).attr("d", path.join(""));
      });
      over = svg.append("path").attr("class", "link picked-line");
      const shape = (node) => {
        const fate = data.closures.fate[node.closure];
        const size = fate === "rejected" ? 34 : 62;
        return d3.symbol(fate === "rival" ? d3.symbolDiamond : d3.symbolCircle, size)();
      };
      svg
        .selectAll("path.dot")
        .data(d3.sort(nodes, (node) => ["rejected", "rival", "refused", "accepted"].indexOf(data.closures.fate[node.closure])))
        .join("path")
        .attr("class", (node) => `dot ${data.closures.fate[node.closure]}`)
        .attr("transform", (node) => `translate(${scale(node)})`)
        .attr("d", shape)
        .append("title")
        .text((node) => `closure ${node.closure}, ${data.closures.fate[node.closure]}`);
      svg.on("click", (event) => {
        const pointer = d3.pointer(event, svg.node());
        const away = (node) => Math.hypot(...scale(node).map((value, axis) => value - pointer[axis]));
        const nearest = d3.least(nodes, away);
        if (nearest && away(nearest) < 20) pcm.pick(nearest.closure);
      });
      mark();
    }

    // The picked closure and the lines to those that it agrees with.
    function mark() {
      if (!nodes.length) return;
      const pair = data.pairs[state.pair];
      const { at } = layout(state.pair);
      const picked = state.picked === null ? undefined : pair.place.get(state.picked);
      const friends = at.has(picked) ? nodes.filter(({ k }) => k !== picked && pair.agree(picked, k)) : [];
      over.attr("d", friends.map((node) => `M${scale(nodes[at.get(picked)])}L${scale(node)}`).join(""));
      d3.select(host)
        .selectAll("path.dot")
        .classed("is-picked", (node) => node.closure === state.picked);
    }
    pcm.redrawn(host, draw);
    pcm.on("pair", () => draw(Math.floor(host.clientWidth)));
    pcm.on("pick", mark);
  }

  pcm.startAgreement = () => {
    const chooser = document.getElementById("matrix-pair");
    if (!chooser) return;
    chooser.addEventListener("change", () => pcm.choosePair(Number(chooser.value)));
    pcm.on("pair", () => (chooser.value = state.pair));
    document.querySelectorAll("[data-draw=matrix]").forEach(matrix);
    document.querySelectorAll("[data-draw=graph]").forEach(graph);
  };
})();
