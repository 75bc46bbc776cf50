"use strict";
// Sorts tables, filters runs, brings out a curve, enlarges pictures. The page can be read without it.
const all = (selector, root = document) => [...root.querySelectorAll(selector)];

function number(cell) { // of a text that begins with one; what has none comes last
  const value = parseFloat(cell.textContent.trim().replace(/,(?=\d{3})/g, ""));
  return Number.isNaN(value) ? null : value;
}

function compare(a, b, falling) {
  const [x, y] = [number(a), number(b)];
  if (x === null || y === null) {
    if (x !== y) return x === null ? 1 : -1;
    return a.textContent.localeCompare(b.textContent) * (falling ? -1 : 1);
  }
  return falling ? y - x : x - y;
}

for (const table of all("table.sortable")) {
  const body = table.tBodies[0];
  if (body.rows.length < 2) continue;
  const heads = all("thead th", table);
  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = head.textContent;
    head.replaceChildren(button);
    button.addEventListener("click", () => {
      // Figures from the largest first, names from A.
      const first = column ? "descending" : "ascending";
      const now = head.getAttribute("aria-sort");
      const order = !now ? first : now === "ascending" ? "descending" : "ascending";
      heads.forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", order);
      const falling = order === "descending";
      const name = (row) => row.cells[0].textContent;
      const rows = [...body.rows].sort((a, b) => column
        ? compare(a.cells[column], b.cells[column], falling)
        : name(a).localeCompare(name(b)) * (falling ? -1 : 1));
      body.append(...rows);
    });
  });
}

const filter = document.getElementById("filter");
if (filter) {
  filter.hidden = false;
  const input = filter.querySelector("input");
  const said = filter.querySelector("span");
  const names = new Set(all("[data-run]").map((part) => part.dataset.run));
  input.addEventListener("input", () => {
    const words = input.value.toLowerCase().split(/\s+/).filter(Boolean);
    const shown = (name) => words.every((word) => name.toLowerCase().includes(word));
    for (const part of all("[data-run]")) {
      if (part instanceof SVGElement) part.style.display = shown(part.dataset.run) ? "" : "none";
      else part.hidden = !shown(part.dataset.run);
    }
    const count = [...names].filter(shown).length;
    said.textContent = words.length ? `${count} of ${names.size} runs` : "";
  });
}

for (const key of all(".key li")) {
  const section = key.closest("section");
  const bring = (on) => {
    section.classList.toggle("dim", on);
    for (const curve of all(".curve", section)) curve.classList.toggle("on", on && curve.dataset.run === key.dataset.run);
  };
  for (const event of ["mouseenter", "focus"]) key.addEventListener(event, () => bring(true));
  for (const event of ["mouseleave", "blur"]) key.addEventListener(event, () => bring(false));
}

const dialog = document.createElement("dialog");
document.body.append(dialog);
dialog.addEventListener("click", () => dialog.close());
for (const picture of all("figure img")) {
  picture.addEventListener("click", () => {
    const large = new Image();
    large.src = picture.src;
    large.alt = picture.alt;
    dialog.replaceChildren(large);
    dialog.showModal();
  });
}
