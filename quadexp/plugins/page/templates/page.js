(() => {
"use strict";
for (const group of document.querySelectorAll(".tabs")) { // each switches the parts of its own section
  const section = group.closest("section"), tabs = [...group.querySelectorAll("[data-metric-switch]")];
  const choose = metric => {
    for (const tab of tabs) tab.setAttribute("aria-pressed", String(tab.dataset.metricSwitch === metric));
    for (const part of section.querySelectorAll("[data-metric]")) part.hidden = part.dataset.metric !== metric;
  };
  for (const tab of tabs) tab.onclick = () => choose(tab.dataset.metricSwitch);
  choose(tabs[0].dataset.metricSwitch);
}

for (const table of document.querySelectorAll("table.sorts")) { // by a click on a heading; gaps last
  const body = table.tBodies[0], heads = [...table.tHead.rows[0].cells];
  const key = (row, i) => {
    const text = row.cells[i].textContent.trim().replace("\u2212", "-");
    return text && !isNaN(text) ? +text : text;
  };
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
  const box = document.querySelector("input[type=search]"), count = document.querySelector(".found");
  box.oninput = () => {
    const words = box.value.toLowerCase().split(/\s+/).filter(Boolean);
    for (const row of body.rows) row.hidden = !words.every(word => row.textContent.toLowerCase().includes(word));
    count.textContent = `${[...body.rows].filter(row => !row.hidden).length} of ${body.rows.length} rows`;
  };
}
})();
