"use strict";
function order(values, descending) {
  const known = v => v !== null && v !== "";
  const less = (a, b) => typeof a === "number" && typeof b === "number" ? a - b
    : String(a).localeCompare(String(b), "en", { numeric: true });
  return values.map((_, i) => i).sort((i, j) => {
    const a = values[i], b = values[j];
    if (!known(a) || !known(b)) return known(b) - known(a) || i - j;
    return (descending ? less(b, a) : less(a, b)) || i - j;
  });
}
function value(cell) {
  if (!cell.hasAttribute("data-v")) return cell.textContent;
  const text = cell.getAttribute("data-v");
  return text === "" ? null : Number(text);
}
function sortable(table) {
  const heads = [...table.tHead.rows[table.tHead.rows.length - 1].cells];
  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const body = table.tBodies[0], rows = [...body.rows];
      const values = rows.map(row => value(row.cells[column]));
      const sorted = head.getAttribute("aria-sort");
      const numbers = values.some(v => typeof v === "number");
      const descending = sorted ? sorted === "ascending" : numbers;
      heads.forEach(other => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", descending ? "descending" : "ascending");
      body.append(...order(values, descending).map(i => rows[i]));
    });
  });
}
if (typeof document !== "undefined") document.querySelectorAll("table.sortable").forEach(sortable);
