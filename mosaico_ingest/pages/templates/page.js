// Behavior of all pages: theme, packed content, the list of recordings, copying. Without scripts, pages show all but packed content.
"use strict";
const packs = new Map();

/** Return the texts of a packed element: a JSON list, compressed and encoded as Base64. */
function unpack(id) {
  if (!packs.has(id)) packs.set(id, decompress(document.getElementById(id).textContent));
  return packs.get(id);
}
async function decompress(text) {
  const bytes = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return JSON.parse(await new Response(stream).text());
}

/** Fill a details element whose content is packed. */
async function fill(details) {
  const { pack, part } = details.dataset;
  if (pack === undefined || details.dataset.filled) return;
  details.dataset.filled = "yes";
  const inside = details.querySelector(".inside");
  inside.innerHTML = (await unpack(pack))[Number(part)];
  window.draw_plots?.(inside);
}
document.addEventListener("toggle", (event) => {
  if (event.target.matches?.("details") && event.target.open) {
    fill(event.target);
    window.draw_plots?.(event.target);
  }
}, true);

/** The list of recordings: filter, order and pages. */
async function set_up_list(list) {
  const pageSize = 50;
  let items = [...list.children];
  if (list.dataset.pack) {
    const template = document.createElement("template");
    template.innerHTML = (await unpack(list.dataset.pack)).join("");
    items = [...template.content.children];
  }
  const form = document.querySelector(".filter");
  form.addEventListener("submit", (event) => event.preventDefault());
  const [words, order, problems] = ["words", "order", "problems"].map((id) => document.getElementById(id));
  const [shown, previous, next] = ["shown", "previous", "next"].map((id) => document.getElementById(id));
  let page = 0;
  const number = (name) => (item) => Number(item.dataset[name] ?? 0);
  const largest = (name) => (a, b) => number(name)(b) - number(name)(a);
  const orders = {
    problems: (a, b) => number("rank")(b) - number("rank")(a),
    name: (a, b) => a.dataset.name.localeCompare(b.dataset.name),
    slowest: largest("seconds"), largest: largest("bytes"), rejected: largest("rejected"), start: () => 0,
  };
  const positions = new Map(items.map((item, at) => [item, at]));
  function show() {
    const wanted = words.value.toLowerCase().split(/\s+/).filter(Boolean);
    const fitting = items.filter((item) =>
      (!problems.checked || number("rank")(item) > 0) &&
      wanted.every((word) => item.dataset.words.toLowerCase().includes(word)));
    fitting.sort((a, b) => orders[order.value](a, b) || positions.get(a) - positions.get(b));
    const last = Math.max(0, Math.ceil(fitting.length / pageSize) - 1);
    page = Math.min(page, last);
    const visible = fitting.slice(page * pageSize, (page + 1) * pageSize);
    list.replaceChildren(...visible);
    previous.disabled = page === 0;
    next.disabled = page === last;
    previous.hidden = next.hidden = last === 0;
    const range = last ? `${page * pageSize + 1} to ${page * pageSize + visible.length} of ` : "";
    const total = fitting.length === items.length ? "" : ` (of ${items.length.toLocaleString("en")})`;
    shown.textContent = `${range}${fitting.length.toLocaleString("en")} recording${fitting.length === 1 ? "" : "s"}${total}`;
  }
  const restart = () => { page = 0; show(); };
  words.addEventListener("input", restart);
  order.addEventListener("change", restart);
  problems.addEventListener("change", restart);
  previous.addEventListener("click", () => { page -= 1; show(); });
  next.addEventListener("click", () => { page += 1; show(); });
  form.hidden = false;
  show();
  /** Show and open the recording that the address names. */
  async function open_target() {
    const id = decodeURIComponent(location.hash.slice(1));
    const target = items.find((item) => item.id === id);
    if (!target) return;
    if (!target.isConnected) {
      words.value = target.dataset.name;
      problems.checked = false;
      restart();
      if (!target.isConnected) list.prepend(target);
    }
    target.open = true;
    await fill(target);
    target.scrollIntoView();
    target.querySelector("summary").focus({ preventScroll: true });
  }
  window.addEventListener("hashchange", open_target);
  open_target();
}

/** The button that switches between the light and the dark theme. */
function set_up_theme() {
  const button = document.getElementById("theme");
  const root = document.documentElement;
  const isDark = () => (root.dataset.theme ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light")) === "dark";
  const label = () => { button.textContent = isDark() ? "Light theme" : "Dark theme"; };
  button.addEventListener("click", () => {
    root.dataset.theme = isDark() ? "light" : "dark";
    label();
    window.redraw_plots?.();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { label(); window.redraw_plots?.(); });
  label();
  button.hidden = false;
}

for (const snippet of document.querySelectorAll(".snippet")) {
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = "Copy";
  button.addEventListener("click", async () => {
    await navigator.clipboard.writeText(snippet.querySelector("code").textContent);
    button.textContent = "Copied";
  });
  snippet.append(button);
}
set_up_theme();
const list = document.getElementById("recordings-list");
if (list) set_up_list(list);
window.draw_plots?.(document);
