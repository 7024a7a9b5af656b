// Plots of scalar fields: drawn when they become visible, with a common time cursor.
"use strict";
const drawn = new Map();
const colors = () => [2, 5, 4, 6, 3, 1].map((number) => css(`--step-${number}`));

/** Return a color of the theme as the canvas needs it. */
function css(name) {
  const probe = document.createElement("i");
  probe.style.color = `var(${name})`;
  document.body.append(probe);
  const color = getComputedStyle(probe).color;
  probe.remove();
  return color;
}

async function draw(figure) {
  if (drawn.has(figure)) return;
  drawn.set(figure, null);
  const text = (await unpack(figure.dataset.pack))[Number(figure.dataset.part)];
  const data = JSON.parse(text);
  const canvas = figure.querySelector(".canvas");
  canvas.replaceChildren();
  const axis = { stroke: css("--dim"), grid: { stroke: css("--line"), width: 1 }, ticks: { stroke: css("--line"), width: 1 } };
  const palette = colors();
  const table = uPlot.join(data.tables.map((one) => [one.x, one.y]));
  const options = {
    width: Math.max(200, canvas.clientWidth), height: 180,
    scales: { x: { time: false } },
    cursor: { sync: { key: "time" }, y: false },
    axes: [{ ...axis, values: (_, ticks) => ticks.map((tick) => `${tick} s`) }, { ...axis, size: 64 }],
    series: [{ label: "time", value: (_, value) => (value == null ? "" : `${value} s`) }, ...data.tables.map((series, at) => ({
      label: series.name, stroke: palette[at % palette.length], width: 1.5, spanGaps: false, points: { show: data.tables[0].x.length < 60 },
      value: (_, value) => (value == null ? "" : `${value}${data.unit ? ` ${data.unit}` : ""}`),
    }))],
  };
  drawn.set(figure, new uPlot(options, table, canvas));
}

const watcher = new IntersectionObserver((entries) => {
  for (const entry of entries) if (entry.isIntersecting) draw(entry.target);
}, { rootMargin: "400px" });
window.draw_plots = (root) => { for (const figure of root.querySelectorAll(".plot")) watcher.observe(figure); };
window.redraw_plots = () => {
  const figures = [...drawn.keys()];
  for (const plot of drawn.values()) plot?.destroy();
  drawn.clear();
  for (const figure of figures) { watcher.unobserve(figure); watcher.observe(figure); }
};
addEventListener("resize", () => {
  for (const [figure, plot] of drawn) plot?.setSize({ width: Math.max(200, figure.querySelector(".canvas").clientWidth), height: 180 });
});
