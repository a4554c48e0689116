(() => {
"use strict";
const html = document.documentElement;
const remembered = key => { try { return localStorage.getItem(key); } catch { return null; } };
const remember = (key, value) => { try { localStorage.setItem(key, value); } catch { /* a file may have no storage */ } };
const system = matchMedia("(prefers-color-scheme: dark)");
const isDark = () => (html.dataset.theme || (system.matches ? "dark" : "light")) === "dark";
const changed = () => document.dispatchEvent(new Event("themechange"));
const theme = remembered("quadexp-theme");
if (theme === "light" || theme === "dark") html.dataset.theme = theme;
document.querySelector("[data-theme-switch]").onclick = () => {
  html.dataset.theme = isDark() ? "light" : "dark";
  remember("quadexp-theme", html.dataset.theme);
  changed();
};
system.addEventListener("change", changed);

for (const group of document.querySelectorAll(".tabs")) { // each switches the parts of its own section
  const section = group.closest("section"), tabs = [...group.querySelectorAll("[data-metric-switch]")];
  const choose = metric => {
    for (const tab of tabs) tab.setAttribute("aria-pressed", String(tab.dataset.metricSwitch === metric));
    for (const part of section.querySelectorAll("[data-metric]")) part.hidden = part.dataset.metric !== metric;
  };
  for (const tab of tabs) tab.onclick = () => choose(tab.dataset.metricSwitch);
  if (tabs.length) choose(tabs[0].dataset.metricSwitch);
}

const boxes = [...document.querySelectorAll(".scroll, .sheet")];
for (const box of boxes) {
  const hint = document.createElement("p");
  hint.className = "more-hint";
  const what = box.classList.contains("sheet") ? "the whole figure" : "all columns";
  hint.textContent = `Wider than the window: scroll sideways for ${what} \u2192`;
  box.before(hint);
}
const measure = () => {
  for (const box of boxes) {
    const first = box.querySelector("th"), wide = box.scrollWidth > box.clientWidth + 1;
    if (first) box.style.setProperty("--first", `${Math.floor(first.getBoundingClientRect().width) - 1}px`);
    box.classList.toggle("over", wide);
    box.previousElementSibling.classList.toggle("on", wide);
  }
};
const sized = new ResizeObserver(measure);
for (const box of boxes) sized.observe(box);
measure();

for (const table of document.querySelectorAll("table.sorts")) { // by a click on a heading; numbers as numbers, gaps last
  const body = table.tBodies[0], heads = [...table.tHead.rows[0].cells];
  const key = (row, i) => { const text = row.cells[i].textContent.trim().replace("\u2212", "-"); return text && !isNaN(text) ? +text : text; };
  const compare = (x, y) => typeof x === typeof y ? (x < y ? -1 : x > y ? 1 : 0) : typeof x === "number" ? -1 : 1;
  heads.forEach((head, i) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    button.onclick = () => {
      const down = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
      for (const other of heads) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", down === 1 ? "ascending" : "descending");
      const rows = [...body.rows].map(row => [row, key(row, i)]);
      rows.sort(([, x], [, y]) => (x === "") - (y === "") || compare(x, y) * down);
      body.append(...rows.map(([row]) => row));
    };
  });
  const box = document.querySelector("input[type=search]"), found = document.querySelector(".found");
  box.oninput = () => {
    const words = box.value.toLowerCase().split(/\s+/).filter(Boolean);
    for (const row of body.rows) row.hidden = !words.every(word => row.textContent.toLowerCase().includes(word));
    found.textContent = `${[...body.rows].filter(row => !row.hidden).length} of ${body.rows.length} rows`;
  };
}

for (const button of document.querySelectorAll("[data-copy]")) {
  button.onclick = async () => {
    const text = button.dataset.copy, said = button.textContent;
    try { await navigator.clipboard.writeText(text); button.textContent = "Copied"; }
    catch { prompt("Copy the command:", text); }
    setTimeout(() => { button.textContent = said; }, 1500);
  };
}
})();
