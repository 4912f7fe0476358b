"use strict";
// Draws the figures of a report's page from the document and the blocks of text in it. Labels are written as text only.
(function () {
  const page = JSON.parse(document.getElementById("document").textContent);
  const GAP = 65535;
  let INK, GRID, FAINT, PAGE, STRIPE, dark;
  const FONT = '11px system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", Arial, sans-serif';
  const AXIS_WIDTH = 118;
  const PRINT_WIDTH = 690;
  const figures = [];
  const timed = [];
  const shownGroups = new Set();
  let range = null; // seconds of what is zoomed to; null: the whole drive
  let printing = false;

  // ---- colours ----------------------------------------------------------------------------------------------------

  /** Read the colours of the page's style: light, dark, or those of paper. */
  function readColours() {
    const style = getComputedStyle(document.documentElement);
    [INK, GRID, FAINT, PAGE, STRIPE] = ["ink", "grid", "faint", "page", "stripe"].map((n) => style.getPropertyValue("--" + n).trim());
    dark = !printing && matchMedia("(prefers-color-scheme: dark)").matches;
  }

  /** A colour of the data, lighter on a dark page; alpha: translucent. */
  function tint(colour, alpha) {
    const n = parseInt(colour.slice(1), 16), parts = [n >> 16, (n >> 8) & 255, n & 255];
    const share = dark ? (Math.max(...parts) < 0x30 ? 0.85 : 0.4) : 0;
    const [r, g, b] = parts.map((c) => Math.round(c + share * (255 - c)));
    return `rgba(${r},${g},${b},${alpha === undefined ? 1 : alpha})`;
  }

  // ---- series -----------------------------------------------------------------------------------------------------

  function bytesOf(name) {
    const text = atob(document.getElementById(name).textContent);
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    return bytes;
  }

  const decoded = new Map();

  /** Values of a series, null where they are not known. */
  function decode(series) {
    if (!decoded.has(series.block)) decoded.set(series.block, decodeNow(series));
    return decoded.get(series.block);
  }

  function decodeNow(series) {
    const n = series.count;
    const planes = inflate(bytesOf(series.block), 2 * n);
    const values = new Array(n);
    let q = 0;
    for (let i = 0; i < n; i++) {
      const folded = planes[i] | (planes[n + i] << 8);
      q = (q + ((folded >>> 1) ^ -(folded & 1))) & 0xffff;
      values[i] = q === GAP ? null : series.low + series.step * q;
    }
    return values;
  }

  // RFC 1950 and 1951: browsers inflate only asynchronously, after the page has been shown without figures.
  const LENGTHS = Array.from({ length: 29 }, (_, i) => (i < 8 ? [3 + i, 0] : i === 28 ? [258, 0] : [3 + ((4 + (i & 3)) << ((i >> 2) - 1)), (i >> 2) - 1]));
  const DISTANCES = Array.from({ length: 30 }, (_, i) => (i < 4 ? [1 + i, 0] : [1 + ((2 + (i & 1)) << ((i >> 1) - 1)), (i >> 1) - 1]));
  const ORDER = [16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15];

  /** Canonical Huffman code: how many codes of each length, and the symbols in the order of their codes. */
  function huffman(lengths) {
    const counts = new Uint16Array(16), next = new Uint16Array(16), symbols = new Uint16Array(lengths.length);
    for (const l of lengths) counts[l]++;
    counts[0] = 0;
    for (let l = 1; l < 16; l++) next[l] = next[l - 1] + counts[l - 1];
    lengths.forEach((l, symbol) => { if (l) symbols[next[l]++] = symbol; });
    return { counts, symbols };
  }

  function inflate(bytes, size) {
    const out = new Uint8Array(size);
    let from = 2, held = 0, count = 0, to = 0, last = false;
    const bits = (n) => {
      while (count < n) { held |= bytes[from++] << count; count += 8; }
      const value = held & ((1 << n) - 1);
      held >>>= n;
      count -= n;
      return value;
    };
    const symbol = ({ counts, symbols }) => {
      let code = 0, first = 0, place = 0;
      for (let l = 1; l < 16; l++) {
        code |= bits(1);
        if (code - first < counts[l]) return symbols[place + code - first];
        place += counts[l];
        first = (first + counts[l]) << 1;
        code <<= 1;
      }
      throw new Error("a damaged series");
    };
    while (!last) {
      last = bits(1) === 1;
      const kind = bits(2);
      if (kind === 0) {
        held = count = 0;
        const length = bytes[from] | (bytes[from + 1] << 8);
        out.set(bytes.subarray(from + 4, from + 4 + length), to);
        from += 4 + length;
        to += length;
        continue;
      }
      let literals, distances;
      if (kind === 1) {
        literals = huffman(Array.from({ length: 288 }, (_, i) => (i < 144 ? 8 : i < 256 ? 9 : i < 280 ? 7 : 8)));
        distances = huffman(new Array(30).fill(5));
      } else {
        const known = bits(5) + 257, ways = bits(5) + 1, used = bits(4) + 4, sizes = new Array(19).fill(0), all = [];
        for (let i = 0; i < used; i++) sizes[ORDER[i]] = bits(3);
        const code = huffman(sizes);
        while (all.length < known + ways) {
          const s = symbol(code);
          if (s < 16) all.push(s);
          else for (let k = s === 16 ? 3 + bits(2) : s === 17 ? 3 + bits(3) : 11 + bits(7), v = s === 16 ? all[all.length - 1] : 0; k > 0; k--) all.push(v);
        }
        literals = huffman(all.slice(0, known));
        distances = huffman(all.slice(known));
      }
      for (let s = symbol(literals); s !== 256; s = symbol(literals)) {
        if (s < 256) { out[to++] = s; continue; }
        const [length, more] = LENGTHS[s - 257], total = length + bits(more);
        const [way, further] = DISTANCES[symbol(distances)], back = way + bits(further);
        for (let k = 0; k < total; k++, to++) out[to] = out[to - back];
      }
    }
    return out;
  }

  /** Time of a figure: its own, or that of all figures of the page. */
  const timeOf = (figure) => figure.data.time || page.time;

  /** Values on the figure's own instants: two a cell. */
  function onGrid(values, cells) {
    if (values.length === 2 * cells) return values;
    const doubled = new Array(2 * cells);
    for (let i = 0; i < cells; i++) doubled[2 * i] = doubled[2 * i + 1] = values[i];
    return doubled;
  }

  function instantsOf({ start, cell, cells }) {
    const instants = new Float64Array(2 * cells);
    for (let i = 0; i < cells; i++) {
      instants[2 * i] = start + (i + 0.25) * cell;
      instants[2 * i + 1] = start + (i + 0.75) * cell;
    }
    return instants;
  }

  const spanOf = ({ start, cell, cells }) => [start, start + cell * cells];
  const whole = () => spanOf(page.time);

  // ---- words ------------------------------------------------------------------------------------------------------

  function shown(value) {
    if (value === null || value === undefined) return "–";
    const size = Math.abs(value);
    if (size !== 0 && (size < 0.001 || size >= 1e5)) return value.toExponential(2);
    return value.toFixed(size < 1 ? 4 : size < 100 ? 3 : 1);
  }

  function secondsShown(s, span) {
    const digits = span > 100 ? 0 : span > 10 ? 1 : span > 1 ? 2 : 3;
    return s.toFixed(digits).replace(/^-(0\.?0*)$/, "$1");
  }

  function element(tag, parent, text, className) {
    const made = document.createElement(tag);
    if (text !== undefined) made.textContent = text;
    if (className) made.className = className;
    if (parent) parent.appendChild(made);
    return made;
  }

  function swatch(parent, item, isBand) {
    const canvas = element("canvas", parent);
    canvas.width = 52;
    canvas.height = 18;
    canvas.setAttribute("aria-hidden", "true");
    swatches.push(() => paintSwatch(canvas, item, isBand));
    paintSwatch(canvas, item, isBand);
  }

  const swatches = [];

  function paintSwatch(canvas, item, isBand) {
    const pen = canvas.getContext("2d");
    pen.clearRect(0, 0, 52, 18);
    if (isBand) {
      pen.fillStyle = tint(item.colour, 0.3);
      pen.fillRect(0, 0, 52, 18);
      return;
    }
    pen.strokeStyle = pen.fillStyle = tint(item.colour);
    if (item.width === undefined && !item.line) {
      pen.beginPath();
      pen.arc(26, 9, 6, 0, 7);
      pen.fill();
      return;
    }
    pen.lineWidth = 2 * (item.width || 1.5);
    pen.setLineDash((item.dash || []).map((d) => 2 * d));
    pen.beginPath();
    pen.moveTo(0, 9);
    pen.lineTo(52, 9);
    pen.stroke();
  }

  function legendItem(figure, item, isBand) {
    const box = element("span", figure.legend, undefined, "item");
    swatch(box, item, isBand);
    const text = element("span", box, item.label);
    return (value) => { text.textContent = value === undefined ? item.label : item.label + " " + value; };
  }

  // ---- axes -------------------------------------------------------------------------------------------------------

  function axis(label, more) {
    return Object.assign(
      { font: FONT, labelFont: FONT, stroke: () => INK, grid: { stroke: () => GRID, width: 1 }, ticks: { stroke: () => FAINT, width: 1, size: 4 },
        label, labelSize: label ? 18 : 0, labelGap: 0, gap: 3 },
      more || {},
    );
  }

  function timeAxis(label) {
    return axis(label, { size: 24, values: byStep });
  }

  /** Write the values of an axis with as many digits as its step has: two ticks never read the same. */
  function byStep(u, splits, i, space, step) {
    let digits = 0;
    while (digits < 6 && Math.abs(step * 10 ** digits - Math.round(step * 10 ** digits)) > 1e-6) digits++;
    return splits.map((s) => (s === null ? null : s.toFixed(digits)));
  }

  /** The axis at the left, as wide in every figure, so that their times stand below one another. */
  function valueAxis(log) {
    const whole = (u, splits) => splits.map((v) => (log && Math.abs(Math.log10(v) % 1) > 1e-9 ? null : v));
    const line = { filter: whole };
    return axis("", { size: AXIS_WIDTH, space: 24, filter: whole, grid: { stroke: () => GRID, width: 1, ...line }, ticks: { stroke: () => FAINT, width: 1, size: 4, ...line } });
  }

  function widthOf(figure) {
    const within = figure.place.parentElement.parentElement.classList.contains("grid");
    if (printing) return within ? PRINT_WIDTH / 2 - 8 : PRINT_WIDTH;
    return Math.max(280, Math.floor(figure.place.clientWidth));
  }

  const moves = (type) => type === "mousemove" || type === "mouseleave";
  const sync = { key: "time", setSeries: false, scales: ["x", null], filters: { pub: moves, sub: moves } };
  const PADDING = [8, 24, 0, 0];

  // ---- figures over time ------------------------------------------------------------------------------------------

  function isShown(item) {
    return !item.group || shownGroups.has(item.group);
  }

  function drawTime(figure) {
    const { data: spec } = figure;
    const time = timeOf(figure);
    const nothing = new Array(2 * time.cells).fill(null);
    const columns = [instantsOf(time)];
    const series = [{}];
    const bands = [];
    figure.items = [];
    for (const band of spec.bands) {
      const at = columns.length;
      figure.items.push({ item: band, at, parts: [band.low, band.high] });
      for (let k = 0; k < 2; k++) {
        columns.push(nothing);
        series.push({ scale: "y", show: false, auto: false, stroke: "transparent", width: 0, points: { show: false } });
      }
      bands.push({ series: [at + 1, at], fill: () => tint(band.colour, 0.2) });
    }
    for (const line of spec.series) {
      figure.items.push({ item: line, at: columns.length, parts: [line.values] });
      columns.push(nothing);
      series.push({ scale: "y", show: false, stroke: () => tint(line.colour), width: line.width, dash: line.dash, points: { show: false } });
    }
    figure.columns = columns;
    fill(figure);
    for (const one of figure.items) for (let k = 0; k < one.parts.length; k++) series[one.at + k].show = isShown(one.item);
    const yScale = spec.log ? { distr: 3, log: 10 } : { range: (u, low, high) => yRange(low, high, spec.level) };
    figure.chart = new uPlot({
      width: widthOf(figure), height: spec.height, padding: PADDING, legend: { show: false },
      scales: { x: { time: false, range: (u, low, high) => [low, high] }, y: yScale },
      axes: [timeAxis(figure.last ? "s from the log's start" : ""), valueAxis(spec.log)],
      series, bands,
      cursor: { sync, drag: { x: true, y: false, setScale: false }, y: false },
      hooks: { draw: [(u) => { drawLevel(u, spec.level); drawMarks(u, spec.marks); }], setSelect: [zoomed], setCursor: [(u) => readOut(figure, u)] },
    }, columns, figure.place);
    figure.chart.over.addEventListener("dblclick", () => zoomTo(null));
    figure.say = figure.items.map((one) => legendItem(figure, one.item, one.parts.length === 2));
    relabel(figure);
  }

  function fill(figure) {
    for (const one of figure.items) {
      if (!isShown(one.item) || one.filled) continue;
      for (let k = 0; k < one.parts.length; k++) figure.columns[one.at + k] = onGrid(decode(one.parts[k]), timeOf(figure).cells);
      one.filled = true;
    }
  }

  function yRange(low, high, level) {
    if (low === null || high === null) return [0, 1];
    if (level !== null && level !== undefined) { low = Math.min(low, level); high = Math.max(high, level); }
    const room = 0.06 * (high - low) || 0.1 * Math.abs(high) || 1;
    return [low >= 0 && low - room < 0 ? 0 : low - room, high + room];
  }

  function drawLevel(u, level) {
    if (level === null || level === undefined) return;
    const y = u.valToPos(level, "y", true);
    const { left, top, width, height } = u.bbox;
    if (!(y >= top && y <= top + height)) return;
    const pen = u.ctx;
    pen.save();
    pen.strokeStyle = FAINT;
    pen.lineWidth = u.pxRatio || 2;
    pen.setLineDash([8, 6]);
    pen.beginPath();
    pen.moveTo(left, y);
    pen.lineTo(left + width, y);
    pen.stroke();
    pen.restore();
  }

  function drawMarks(u, marks) {
    if (!marks || !marks.length) return;
    const pen = u.ctx, r = devicePixelRatio, { left, top, width, height } = u.bbox;
    pen.save();
    pen.font = FONT.replace("11px", 10 * r + "px");
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    for (let i = marks.length - 1; i >= 0; i--) {
      const x = u.valToPos(marks[i].at_s, "x", true);
      if (x < left || x > left + width) continue;
      const y = Math.max(top + 8 * r, Math.min(top + height - 8 * r, u.valToPos(marks[i].value, "y", true)));
      pen.beginPath();
      pen.arc(x, y, 7 * r, 0, 7);
      pen.fillStyle = PAGE;
      pen.fill();
      pen.lineWidth = 1.2 * r;
      pen.strokeStyle = pen.fillStyle = INK;
      pen.stroke();
      pen.fillText(marks[i].label, x, y + 0.5 * r);
    }
    pen.restore();
  }

  function readOut(figure, u) {
    const at = u.cursor.idx;
    figure.items.forEach((one, i) => {
      if (!isShown(one.item)) return;
      if (at === null || at === undefined) return figure.say[i]();
      const values = one.parts.map((_, k) => shown(figure.columns[one.at + k][at]));
      figure.say[i](values.join(" to "));
    });
  }

  function relabel(figure) {
    figure.items.forEach((one, i) => { figure.legend.children[i].hidden = !isShown(one.item); });
  }

  // ---- the strip --------------------------------------------------------------------------------------------------

  const ROW = 17;
  const WHOLE = [1, 2, 5].flatMap((k) => [1, 1e1, 1e2, 1e3, 1e4, 1e5].map((d) => k * d)).sort((a, b) => a - b);

  function drawStrip(figure) {
    const rows = figure.data.rows;
    figure.chart = new uPlot({
      width: widthOf(figure), height: rows.length * ROW + 52, padding: PADDING, legend: { show: false },
      scales: { x: { time: false, range: (u, low, high) => [low, high] }, y: { range: [0, rows.length] } },
      axes: [timeAxis("s from the log's start"), axis("", {
        size: AXIS_WIDTH, splits: () => rows.map((_, i) => rows.length - 0.5 - i), values: () => rows.map((r) => fitted(r.label)),
        grid: { show: false }, ticks: { show: false },
      })],
      series: [{}, { scale: "y", stroke: "transparent", points: { show: false } }],
      cursor: { sync, drag: { x: true, y: false, setScale: false }, points: { show: false } },
      hooks: { draw: [(u) => drawSpans(u, rows)], setSelect: [zoomed], setCursor: [(u) => sayWhat(figure, u)] },
    }, [[whole()[0], whole()[1]], [0, 0]], figure.place);
    figure.chart.over.addEventListener("dblclick", () => zoomTo(null));
    figure.chart.setScale("x", { min: whole()[0], max: whole()[1] });
  }

  function fitted(label) {
    return label.length > 20 ? label.slice(0, 9) + "…" + label.slice(-10) : label;
  }

  function drawSpans(u, rows) {
    const pen = u.ctx, { left, top, width, height } = u.bbox, r = devicePixelRatio;
    pen.save();
    pen.beginPath();
    pen.rect(left, top, width, height);
    pen.clip();
    const tall = height / rows.length;
    rows.forEach((row, i) => {
      if (i % 2) { pen.fillStyle = STRIPE; pen.fillRect(left, top + i * tall, width, tall); }
      pen.fillStyle = tint(row.colour);
      for (const [start, end] of row.spans) {
        const a = u.valToPos(start, "x", true), b = u.valToPos(end, "x", true);
        if (b < left || a > left + width) continue;
        pen.fillRect(a, top + i * tall + 0.2 * tall, Math.max(b - a, 1.5 * r), 0.6 * tall);
      }
    });
    pen.restore();
  }

  function sayWhat(figure, u) {
    const { left, top } = u.cursor;
    const said = [];
    if (left >= 0) {
      const at = u.posToVal(left, "x"), near = 3 * (u.scales.x.max - u.scales.x.min) / u.over.clientWidth;
      for (const row of figure.data.rows) {
        const hit = row.spans.find(([start, end]) => at >= start - near && at <= end + near);
        if (hit) said.push(row.label + " " + hit[0].toFixed(2) + "–" + hit[1].toFixed(2) + " s" + (hit[2] ? ": " + hit[2] : ""));
      }
    }
    figure.legend.textContent = said.join(" · ");
  }

  // ---- zoom -------------------------------------------------------------------------------------------------------

  function zoomed(u) {
    if (u.select.width < 3) return;
    const low = u.posToVal(u.select.left, "x"), high = u.posToVal(u.select.left + u.select.width, "x");
    u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
    zoomTo([low, high]);
  }

  function zoomTo(wanted) {
    const [first, last] = whole();
    if (wanted) {
      const low = Math.max(first, wanted[0]), high = Math.min(last, wanted[1]);
      wanted = high - low > 2 * page.time.cell ? [low, high] : [low - page.time.cell, high + page.time.cell];
    }
    range = wanted;
    const [low, high] = range || whole();
    for (const figure of timed) figure.chart.setScale("x", { min: low, max: high });
    for (const figure of figures) if (figure.follows) figure.chart.redraw(false);
    const span = high - low;
    for (const place of document.querySelectorAll(".tools .range")) {
      place.textContent = secondsShown(low, span) + " to " + secondsShown(high, span) + " s" + (range ? "" : " (whole drive)");
    }
  }

  /** Zoom by the keyboard: + and -, arrows move, Home and 0 show the whole drive. */
  function keyed(event) {
    const [first, last] = whole(), [low, high] = range || [first, last], span = high - low, middle = (low + high) / 2;
    const to = {
      "+": [middle - span / 4, middle + span / 4], "=": [middle - span / 4, middle + span / 4],
      "-": [middle - span, middle + span],
      ArrowLeft: [Math.max(first, low - span / 4), Math.max(first + span, high - span / 4)],
      ArrowRight: [Math.min(last - span, low + span / 4), Math.min(last, high + span / 4)],
      Home: null, 0: null,
    }[event.key];
    if (to === undefined || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    zoomTo(to && to[1] - to[0] < last - first ? to : null);
  }

  // ---- points, intervals, bars ------------------------------------------------------------------------------------

  function drawPoints(figure) {
    const spec = figure.data;
    const clouds = [];
    for (const cloud of spec.clouds) {
      clouds.push({ cloud, x: decode(cloud.x), y: decode(cloud.y), at: cloud.at_s ? decode(cloud.at_s) : null });
    }
    figure.follows = clouds.some((c) => c.at);
    const [left, right] = extent(clouds.map((c) => c.x), spec.log), [low, high] = extent(clouds.map((c) => c.y), spec.log);
    const height = () => (printing ? 270 : 330);
    figure.height = height;
    const ranges = () => {
      if (!spec.equal) return [[left, right], [low, high]];
      const wide = widthOf(figure) - 66, tall = height() - 52;
      const scale = Math.max((right - left) / wide, (high - low) / tall) || 1;
      const cx = (left + right) / 2, cy = (low + high) / 2;
      return [[cx - (scale * wide) / 2, cx + (scale * wide) / 2], [cy - (scale * tall) / 2, cy + (scale * tall) / 2]];
    };
    // uPlot's own filter leaves a horizontal logarithmic axis of less than a decade without a number.
    const decades = (u, splits) => {
      const wide = (widthOf(figure) - 66) / Math.log10(right / left);
      const digits = wide > 250 ? "12357" : wide > 120 ? "125" : "1";
      return splits.map((v) => (v !== null && digits.includes(v.toExponential()[0]) ? v : null));
    };
    const scale = (k) => (spec.log ? { time: false, distr: 3, range: () => ranges()[k] } : { time: false, range: () => ranges()[k] });
    figure.chart = new uPlot({
      width: widthOf(figure), height: height(), legend: { show: false },
      scales: { x: scale(0), y: scale(1) },
      axes: [axis(spec.x_label, { size: 26, ...(spec.log ? { filter: decades } : {}) }), axis(spec.y_label, { size: 46 })],
      series: [{}, { scale: "y", stroke: "transparent", points: { show: false } }],
      cursor: { show: false },
      hooks: { draw: [(u) => clouds.forEach((c) => paint(u, c))] },
    }, [[left, right], [low, high]], figure.place);
    for (const { cloud } of clouds) legendItem(figure, cloud, false);
  }

  function extent(lists, log) {
    let low = Infinity, high = -Infinity;
    for (const list of lists) for (const v of list) if (v !== null && (!log || v > 0)) { if (v < low) low = v; if (v > high) high = v; }
    if (low > high) return log ? [0.1, 1] : [0, 1];
    if (log) return [low / 1.2, high * 1.2];
    const room = 0.04 * (high - low) || 0.5;
    return [low - room, high + room];
  }

  function paint(u, { cloud, x, y, at }) {
    const pen = u.ctx, r = devicePixelRatio, { left, top, width, height } = u.bbox;
    const [first, last] = range || [-Infinity, Infinity];
    pen.save();
    pen.beginPath();
    pen.rect(left, top, width, height);
    pen.clip();
    const { x: sx, y: sy } = u.scales;
    const linear = sx.distr !== 3;
    const kx = width / (sx.max - sx.min), ky = height / (sy.max - sy.min);
    const px = (v) => (linear ? left + (v - sx.min) * kx : u.valToPos(v, "x", true));
    const py = (v) => (linear ? top + height - (v - sy.min) * ky : u.valToPos(v, "y", true));
    pen.strokeStyle = pen.fillStyle = tint(cloud.colour);
    if (cloud.line) {
      pen.lineWidth = 1.5 * r;
      pen.lineJoin = "round";
      pen.beginPath();
      let drawing = false;
      for (let i = 0; i < x.length; i++) {
        const use = x[i] !== null && y[i] !== null && (!at || (at[i] >= first && at[i] <= last));
        if (use && drawing) pen.lineTo(px(x[i]), py(y[i]));
        else if (use) pen.moveTo(px(x[i]), py(y[i]));
        drawing = use;
      }
      pen.stroke();
    } else {
      const size = (x.length > 3000 ? 1.4 : x.length > 300 ? 2 : 5) * r;
      pen.globalAlpha = x.length > 3000 ? 0.5 : 0.75;
      for (let i = 0; i < x.length; i++) {
        if (x[i] === null || y[i] === null || (at && !(at[i] >= first && at[i] <= last))) continue;
        pen.fillRect(px(x[i]) - size / 2, py(y[i]) - size / 2, size, size);
      }
    }
    pen.restore();
  }

  function drawIntervals(figure) {
    const { intervals, unit, zero } = figure.data;
    const known = intervals.flatMap((i) => [i.low, i.middle, i.high]).concat(zero === null || zero === undefined ? [] : [zero]);
    const [low, high] = extent([known], false);
    figure.chart = new uPlot({
      width: widthOf(figure), height: intervals.length * 24 + 56, legend: { show: false },
      scales: { x: { time: false, range: [low, high] }, y: { range: [0, intervals.length] } },
      axes: [axis(unit, { size: 26, values: byStep }), axis("", {
        size: 150, splits: () => intervals.map((_, i) => intervals.length - 0.5 - i), values: () => intervals.map((i) => fitted(i.label)),
        grid: { show: false }, ticks: { show: false },
      })],
      series: [{}, { scale: "y", stroke: "transparent", points: { show: false } }],
      cursor: { show: false },
      hooks: { draw: [(u) => paintIntervals(u, intervals, zero)] },
    }, [[low, high], [0, 0]], figure.place);
  }

  function paintIntervals(u, intervals, zero) {
    const pen = u.ctx, r = devicePixelRatio, { top, height } = u.bbox;
    pen.save();
    if (zero !== null && zero !== undefined) {
      const x = u.valToPos(zero, "x", true);
      pen.strokeStyle = INK;
      pen.setLineDash([4 * r, 3 * r]);
      pen.lineWidth = r;
      pen.beginPath();
      pen.moveTo(x, top);
      pen.lineTo(x, top + height);
      pen.stroke();
      pen.setLineDash([]);
    }
    intervals.forEach((one, i) => {
      const y = top + ((i + 0.5) * height) / intervals.length;
      const [a, m, b] = [one.low, one.middle, one.high].map((v) => (v === null ? null : u.valToPos(v, "x", true)));
      pen.strokeStyle = pen.fillStyle = tint(one.colour);
      pen.lineWidth = 2 * r;
      if (a !== null && b !== null) {
        pen.beginPath();
        pen.moveTo(a, y);
        pen.lineTo(b, y);
        for (const end of [a, b]) { pen.moveTo(end, y - 4 * r); pen.lineTo(end, y + 4 * r); }
        pen.stroke();
      }
      if (m !== null) {
        pen.beginPath();
        pen.arc(m, y, 4 * r, 0, 7);
        pen.fill();
      }
    });
    pen.restore();
  }

  function drawBars(figure) {
    const { edges, counts, unit, colour } = figure.data;
    const most = Math.max(1, ...counts);
    figure.chart = new uPlot({
      width: widthOf(figure), height: 220, legend: { show: false },
      scales: { x: { time: false, range: [edges[0], edges[edges.length - 1]] }, y: { range: [0, 1.06 * most] } },
      axes: [axis(unit, { size: 26 }), axis("number", { size: 46, incrs: WHOLE })],
      series: [{}, { scale: "y", stroke: "transparent", points: { show: false } }],
      cursor: { show: false },
      hooks: { draw: [(u) => {
        u.ctx.save();
        u.ctx.fillStyle = tint(colour);
        counts.forEach((count, i) => {
          const a = u.valToPos(edges[i], "x", true), b = u.valToPos(edges[i + 1], "x", true);
          const y = u.valToPos(count, "y", true);
          u.ctx.fillRect(a + 1, y, Math.max(b - a - 2, 1), u.valToPos(0, "y", true) - y);
        });
        u.ctx.restore();
      }] },
    }, [[edges[0], edges[edges.length - 1]], [0, most]], figure.place);
  }

  // ---- the page ---------------------------------------------------------------------------------------------------

  const draw = { time: drawTime, strip: drawStrip, points: drawPoints, intervals: drawIntervals, bars: drawBars };

  function makeToggles() {
    const groups = new Set();
    for (const figure of timed) for (const item of [...(figure.data.series || []), ...(figure.data.bands || [])]) if (item.group) groups.add(item.group);
    const place = document.querySelector(".tools .toggles");
    if (!place || !groups.size) return;
    element("span", place, "Also show: ");
    for (const group of groups) {
      const label = element("label", place);
      const box = element("input", label);
      box.type = "checkbox";
      label.append(" " + group + " ");
      box.addEventListener("change", () => {
        if (box.checked) shownGroups.add(group); else shownGroups.delete(group);
        for (const figure of timed) if (figure.items) refill(figure);
      });
    }
  }

  function refill(figure) {
    fill(figure);
    const u = figure.chart, [low, high] = range || whole();
    u.batch(() => {
      u.setData(figure.columns, false);
      for (const one of figure.items) {
        for (let k = 0; k < one.parts.length; k++) u.setSeries(one.at + k, { show: isShown(one.item) });
      }
      u.setScale("x", { min: low, max: high });
    });
    relabel(figure);
  }

  function resizeAll() {
    for (const figure of figures) {
      if (figure.chart) figure.chart.setSize({ width: widthOf(figure), height: figure.height ? figure.height() : figure.chart.height });
    }
  }

  // Select the text, so that a browser that refuses leaves one key to press.
  function copy(button) {
    getSelection().selectAllChildren(document.getElementById(button.dataset.of));
    const done = document.execCommand("copy");
    button.parentElement.querySelector(".copied").textContent = done ? "Copied." : "Selected: press Ctrl+C.";
  }

  function start() {
    readColours();
    for (const node of document.querySelectorAll("[data-figure]")) {
      const data = page.figures[node.dataset.figure];
      const figure = { data, place: node.querySelector(".canvas"), legend: node.querySelector(".legend") };
      figure.place.setAttribute("role", "img");
      if (data.kind === "time" || data.kind === "strip") figure.place.addEventListener("keydown", keyed);
      figures.push(figure);
      if (data.kind === "time" || data.kind === "strip") timed.push(figure);
    }
    if (timed.length) timed[timed.length - 1].last = true;
    for (const figure of figures) draw[figure.data.kind](figure);
    makeToggles();
    if (page.time) zoomTo(null);
    for (const figure of timed) if (figure.data.time) figure.chart.setScale("x", { min: spanOf(figure.data.time)[0], max: spanOf(figure.data.time)[1] });
    for (const button of document.querySelectorAll("button.jump")) {
      button.addEventListener("click", () => {
        zoomTo([Number(button.dataset.from), Number(button.dataset.to)]);
        if (timed.length) timed[0].place.parentElement.scrollIntoView({ block: "start" });
      });
    }
    for (const button of document.querySelectorAll("button.whole")) button.addEventListener("click", () => zoomTo(null));
    for (const button of document.querySelectorAll("button.copy")) button.addEventListener("click", () => copy(button));
    let waiting = 0;
    addEventListener("resize", () => {
      clearTimeout(waiting);
      waiting = setTimeout(resizeAll, 100);
    });
    const repaint = () => {
      readColours();
      resizeAll();
      for (const figure of figures) figure.chart.redraw(true);
      for (const paint of swatches) paint();
    };
    addEventListener("beforeprint", () => { printing = true; repaint(); });
    addEventListener("afterprint", () => { printing = false; repaint(); });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", repaint);
    document.documentElement.dataset.drawn = String(figures.length);
  }

  try {
    start();
  } catch (error) {
    document.querySelector("h1").after(element("p", null, "The figures cannot be drawn: " + error, "note"));
    throw error;
  }
})();
