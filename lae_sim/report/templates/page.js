"use strict";
/* The page can be read without this: it sorts tables and chooses their columns, saves figures,
   chooses colours, and moves through sequences frame by frame. */

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
function made(tag, properties, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}
const headings = table => [...table.tHead.rows[table.tHead.rows.length - 1].cells];

function sortable(table) {
  const heads = headings(table);
  heads.forEach((head, column) => {
    const button = made("button", { type: "button" }, ...head.childNodes);
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

/* How many of a group's columns are shown: [3, 2] of spans [3, 2] if all are. */
function spans(widths, shown) {
  let start = 0;
  return widths.map(width => shown.slice(start, start += width).filter(Boolean).length);
}
function choosable(table) {
  const heads = headings(table), minor = heads.filter(head => head.hasAttribute("data-minor"));
  if (!minor.length && heads.length < 8) return;
  const groups = [...table.querySelectorAll("tr.groups > *")];
  const widths = groups.map(group => group.colSpan);
  const above = widths.flatMap((width, g) => Array(width).fill(groups[g].textContent.trim()));
  const boxes = heads.map((head, column) =>
    made("input", { type: "checkbox", checked: !head.hasAttribute("data-minor"), disabled: !column }));
  const show = columns => {
    for (const row of [heads, ...[...table.tBodies[0].rows].map(row => row.cells)])
      for (const column of columns) row[column].hidden = !boxes[column].checked;
    spans(widths, boxes.map(box => box.checked)).forEach((span, g) => {
      groups[g].hidden = !span;
      groups[g].colSpan = span || 1;
    });
  };
  const labels = heads.map((head, column) => made("label", { title: head.title }, boxes[column],
    ` ${above[column] ? above[column] + " " : ""}${head.textContent}`));
  const summary = made("summary", {}), all = made("button", { type: "button" }, "all");
  const count = () => {
    summary.textContent = `Columns: ${boxes.filter(box => box.checked).length} of ${boxes.length}`;
  };
  const choose = columns => {
    show(columns);
    count();
    edges(table.closest(".scroll"));
  };
  boxes.forEach((box, column) => box.addEventListener("change", () => choose([column])));
  all.addEventListener("click", () => {
    for (const box of boxes) box.checked = true;
    choose([...boxes.keys()]);
  });
  const chooser = made("details", { className: "columns" }, summary,
    made("fieldset", { ariaLabel: "Columns of the table" }, ...labels), all);
  table.closest(".wide").before(chooser);
  show(heads.flatMap((head, column) => boxes[column].checked ? [] : [column]));
  count();
}

/* Mark the edges of a table beyond which there is more of it. */
function edges(scroller) {
  const wide = scroller.parentElement, first = scroller.querySelector("tbody th");
  const caption = scroller.querySelector("caption");
  const left = scroller.scrollLeft, more = scroller.scrollWidth - scroller.clientWidth - left;
  wide.classList.toggle("before", left > 1);
  wide.classList.toggle("after", more > 1);
  if (first) wide.style.setProperty("--first", `${first.offsetWidth + 1}px`);
  const top = caption ? caption.offsetHeight - scroller.scrollTop : 0;
  wide.style.setProperty("--top", `${Math.max(top, 0) + 1}px`);
}

function saved(file, name) {
  const link = made("a", { href: URL.createObjectURL(file), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}
/* What makes a figure black on white, whatever the page is. */
const light = text => text.replace(/var\(--\w+, (#\w+)\)/g, "$1");

function savable(figure) {
  const svg = figure.querySelector("svg"), name = figure.dataset.name;
  const standalone = () => light(new XMLSerializer().serializeToString(svg));
  const asSvg = made("button", { type: "button" }, "Save as SVG");
  const asPng = made("button", { type: "button" }, "Save as PNG");
  asSvg.addEventListener("click", () =>
    saved(new Blob([standalone()], { type: "image/svg+xml" }), `${name}.svg`));
  asPng.addEventListener("click", () => {
    const image = new Image(), canvas = document.createElement("canvas");
    const { width, height } = svg.viewBox.baseVal, scale = 3;
    image.addEventListener("load", () => {
      Object.assign(canvas, { width: scale * width, height: scale * height });
      canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
      canvas.toBlob(file => saved(file, `${name}.png`));
    });
    image.src = `data:image/svg+xml,${encodeURIComponent(standalone())}`;
  });
  figure.append(made("div", { className: "save" }, asSvg, asPng));
}

function themed(group) {
  const media = { auto: "screen and (prefers-color-scheme: dark)", light: "not all", dark: "screen" };
  const buttons = [...group.querySelectorAll("button")];
  for (const button of buttons) button.addEventListener("click", () => {
    document.getElementById("dark").media = media[button.textContent];
    for (const each of buttons) each.setAttribute("aria-pressed", String(each === button));
  });
  group.hidden = false;
}

/* The frame whose arrival is the last one before a time, both in frame intervals. */
function frameAt(arrivals, time) {
  let low = 0, high = arrivals.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (arrivals[middle] <= time) low = middle; else high = middle - 1;
  }
  return low;
}
function watchable(figure) {
  const data = JSON.parse(figure.dataset.closeup), find = selector => figure.querySelector(selector);
  const [slider, play, output] = ["input", ".controls button", "output"].map(find);
  const [strip, overview, stages] = [".strip", ".overview", ".stages"].map(find);
  const [whole, target] = figure.querySelectorAll("image");
  const rects = [...figure.querySelectorAll(".stages g rect")];
  const values = [...figure.querySelectorAll(".legend b")];
  const scroller = strip.parentElement, zoom = find(".zoom"), length = overview.viewBox.baseVal.width;
  let timer = null;

  function show(frame) {
    data.boxes.forEach((boxes, b) => {
      const place = boxes[frame];
      rects[b].style.display = place ? "" : "none";
      if (place) ["x", "y", "width", "height"].forEach((name, k) =>
        rects[b].setAttribute(name, k < 2 ? place[k] : Math.max(place[k], 0)));
    });
    const picture = data.pictures[frame - data.first];
    for (const image of [whole, target]) if (image) image.style.display = picture ? "" : "none";
    stages.classList.toggle("bare", !picture);
    if (picture) {
      whole.setAttribute("href", `data:image/jpeg;base64,${picture[0]}`);
      target.setAttribute("href", picture[1] ? `data:image/jpeg;base64,${picture[1]}` : "");
      ["x", "y", "width", "height"].forEach((name, k) => target.setAttribute(name, picture[2 + k]));
    }
    const centre = data.boxes[0][frame] || data.boxes[1][frame];
    if (centre) {
      const [x, y, w, h] = centre, side = Math.max(3 * Math.max(w, h), 24);
      zoom.firstElementChild.setAttribute("viewBox",
        `${x + w / 2 - side / 2} ${y + h / 2 - side / 2} ${side} ${side}`);
    }
    const left = (data.arrivals[frame] + .5) * data.pixels;
    for (const cursor of figure.querySelectorAll(".cursor")) {
      cursor.setAttribute("x1", left);
      cursor.setAttribute("x2", left);
    }
    values.forEach((element, k) => {
      const overlap = data.overlaps[k][frame];
      element.textContent = overlap === null ? "–" : overlap.toFixed(2);
    });
    const age = data.ages[frame], time = (data.arrivals[frame] / data.fps).toFixed(2);
    output.value = `frame ${frame}, ${time} s: answered by the output of frame ${frame - age}`
      + (age ? `, ${age} before` : "") + (data.pictures.length && !picture ? "; no picture" : "");
    slider.value = frame;
    slider.setAttribute("aria-valuetext", output.value);
    return left;
  }
  function go(frame) {
    const left = show(frame);
    if (left < scroller.scrollLeft + 40 || left > scroller.scrollLeft + scroller.clientWidth - 40)
      scroller.scrollLeft = left - scroller.clientWidth / 3;
  }
  function stop() {
    clearInterval(timer);
    timer = null;
    play.setAttribute("aria-pressed", "false");
  }
  const at = (event, svg, width) => {
    const place = svg.getBoundingClientRect();
    return frameAt(data.arrivals, (event.clientX - place.left) / place.width * width / data.pixels);
  };
  slider.addEventListener("input", () => { stop(); go(Number(slider.value)); });
  strip.addEventListener("pointermove", event => { stop(); show(at(event, strip, length)); });
  for (const kind of ["pointerdown", "pointermove"]) overview.addEventListener(kind, event => {
    if (kind === "pointerdown" || event.buttons || event.pointerType === "mouse") {
      stop();
      go(at(event, overview, length));
    }
  });
  play.addEventListener("click", () => {
    if (timer) return stop();
    play.setAttribute("aria-pressed", "true");
    timer = setInterval(() => {
      const next = Number(slider.value) + 1;
      if (next > Number(slider.max)) stop(); else go(next);
    }, 1000 / data.fps);
  });
  zoom.hidden = find(".controls").hidden = false;
  go(Number(slider.value));
}

if (typeof document !== "undefined") {
  document.querySelectorAll("table.sortable").forEach(table => { choosable(table); sortable(table); });
  document.querySelectorAll(".scroll").forEach(scroller => {
    scroller.addEventListener("scroll", () => edges(scroller), { passive: true });
    new ResizeObserver(() => edges(scroller)).observe(scroller);
  });
  document.querySelectorAll("figure.picture").forEach(savable);
  document.querySelectorAll("figure.closeup").forEach(watchable);
  document.querySelectorAll(".theme").forEach(themed);
}
