// Quantiles of measured errors against those that the stated errors promise.
pcm.startCalibration = () => {
  document.querySelectorAll("[data-draw=quantiles]").forEach((host) => {
    const { expected, observed } = pcm.data.quantiles[host.dataset.plot];
    pcm.redrawn(host, (width) => {
      const [height, margin] = [Math.min(width, 340), { top: 8, right: 12, bottom: 40, left: 48 }];
      const most = d3.max([...expected, ...observed]) || 1;
      const x = d3.scaleLinear([0, most], [margin.left, width - margin.right]).nice();
      const y = d3.scaleLinear([0, most], [height - margin.bottom, margin.top]).nice();
      const svg = pcm.drawing(host, width, height, `Quantiles of ${expected.length} errors; on the diagonal they are as stated.`);
      svg.append("g").attr("class", "axis").attr("transform", `translate(0,${height - margin.bottom})`).call(d3.axisBottom(x).ticks(5));
      svg.append("g").attr("class", "axis").attr("transform", `translate(${margin.left},0)`).call(d3.axisLeft(y).ticks(5));
      pcm.nameAxes(svg, ["if errors are as stated", "as measured"], margin, width, height);
      svg.append("path").attr("class", "diagonal").attr("d", `M${x(0)},${y(0)}L${x(most)},${y(most)}`);
      svg.append("path").attr("class", "ends accepted").attr("stroke-width", 5).attr("d", expected.map((value, k) => `M${x(value)},${y(observed[k])}h0`).join(""));
    });
  });
};
