/* Tables and texts. What a recording says is only ever set as text. */
"use strict";
var mp4dsTables = (() => {
  const {numberText} = mp4dsPlots;

  function element(name, options = {}, children = []) {
    const made = document.createElement(name);
    for (const [key, value] of Object.entries(options)) {
      if (key === "class") made.className = value;
      else if (key === "text") made.textContent = value;
      else made.setAttribute(key, value);
    }
    made.append(...children);
    return made;
  }

  function bytesText(count) {
    if (count === null || count === undefined) return "";
    for (const unit of ["B", "kB", "MB", "GB"]) {
      if (count < 1000) return unit === "B" ? `${count} B` : `${count.toFixed(1)} ${unit}`;
      count /= 1000;
    }
    return `${count.toFixed(2)} TB`;
  }

  const optional = (value, digits) => value === null || value === undefined ? "" : value.toFixed(digits);
  const grouped = value => value === null || value === undefined ? "" : value.toLocaleString("en");

  /** Nanoseconds since 1970 (BigInt) as seconds with nine decimals. */
  function stampText(time) {
    const size = time < 0n ? -time : time;
    return `${time < 0n ? "-" : ""}${size / 1000000000n}.${String(size % 1000000000n).padStart(9, "0")}`;
  }

  /** Nanoseconds since 1970 as date and time in UTC; empty outside the calendar. */
  function dateText(time) {
    let whole = time / 1000000000n, part = time % 1000000000n;
    if (part < 0n) { part += 1000000000n; whole -= 1n; }
    const date = new Date(Number(whole) * 1000);
    if (Number.isNaN(date.getTime())) return "";
    return `${date.toISOString().slice(0, -5).replace("T", " ")}.${String(part).padStart(9, "0")} UTC`;
  }

  function table(place, head, rows) {
    const cell = (kind, text, {number, bad, long} = {}) => {
      const classes = [number && "number", bad && "bad", long && "long"].filter(Boolean).join(" ");
      return element(kind, {text, ...(classes && {class: classes})});
    };
    place.replaceChildren(
      element("thead", {}, [element("tr", {}, head.map(([text, options]) => cell("th", text, options)))]),
      element("tbody", {}, rows.map(row => element("tr", {}, row.map((value, i) => {
        const [text, more] = Array.isArray(value) ? value : [value, {}];
        return cell("td", text, {...head[i][1], ...more});
      })))));
  }

  function summary(place, data, seconds) {
    const facts = data.summary, shown = [];
    const add = (name, value) => { if (value) shown.push(element("div", {}, [element("dt", {text: name}), element("dd", {text: value})])); };
    add("Length", mp4dsPlots.timeText(seconds, 1));
    add("Cameras", String(data.cameras.length));
    add("Topics", grouped(facts.topics));
    add("Messages", grouped(facts.messages));
    if (facts.bytes) {
      add("Recording", bytesText(facts.source_bytes));
      add("Dataset", bytesText(facts.bytes));
      add("Ratio", facts.source_bytes ? `${(facts.source_bytes / facts.bytes).toFixed(2)} ×` : "");
    }
    add("Profile", facts.profile);
    place.replaceChildren(...shown);
  }

  const NUMBER = {number: true};

  function timing(place, cameras, compared) {
    const {quantile, delays} = mp4dsColumns, reference = compared ? compared.facts.name : "";
    const head = [["Camera", {long: true}], ["Frames", NUMBER], ["Rate, Hz", NUMBER], ["Interval, ms", NUMBER], ["Jitter, ms", NUMBER],
      ["99 % within", NUMBER], ["Longest, ms", NUMBER], ["Lost", NUMBER], ["Repeated", NUMBER], ["Backward", NUMBER],
      ["seq missing", NUMBER], ["Record − stamp, ms", NUMBER]];
    if (reference) head.push(["Offset, ms", NUMBER]);
    table(place, head, cameras.map(camera => {
      const {timing: t, facts, offsets} = camera, count = (value, more = "") => [grouped(value) + more, {bad: value > 0}];
      const delay = delays(camera.logTime, camera.stamp).sort();
      const row = [facts.name, grouped(camera.frames), optional(t.rate, 2), optional(t.median, 3), optional(t.jitter, 3), optional(t.within, 3),
        optional(t.longest, 1), count(t.missing, t.gaps ? ` in ${grouped(t.gaps)} gaps` : ""), count(t.repeated), count(t.backward),
        facts.seq_missing === null ? "" : count(facts.seq_missing),
        facts.untimed || `${numberText(quantile(delay, 0.5))} (${numberText(delay[0])} to ${numberText(delay.at(-1))})`];
      const share = values => `${numberText(quantile(values.slice().sort(), 0.5))} (99 % within ${numberText(quantile(values.map(Math.abs).sort(), 0.99))})`;
      if (reference) row.push(offsets ? share(offsets) : facts.untimed || "reference");
      return row;
    }));
    return "Interval is the median interval between header stamps, jitter its standard deviation. An interval longer than 1.5 medians counts as lost frames, unless shorter neighbouring intervals make up for it; "
      + "repeated frames have the same stamp as the previous frame."
      + (reference ? ` Offset is each frame's stamp minus that of the nearest frame of ${reference}.` : "");
  }

  function topics(place, data) {
    const head = [["Topic", {long: true}], ["Type", {long: true}], ["Messages", NUMBER], ["Rate, Hz", NUMBER], ["Stored", NUMBER],
      ["In", {long: true}]];
    table(place, head, data.topics.map(row => [row.topic, row.type_name, grouped(row.messages), optional(row.rate_hz, 2),
      bytesText(row.bytes), row.stored || "messages.mcap"]));
  }

  function calibrations(place, data) {
    const rowsOf = (values, step) => values.map((value, i) => `${i % step ? ", " : i ? "\n     " : ""}${numberOf(value)}`).join("");
    const numberOf = value => String(Number(value.toPrecision(10)));
    const made = [];
    for (const camera of data.cameras) {
      for (const item of camera.calibrations.slice(0, 8)) {
        const size = `${item.width}x${item.height}`, from = item.from_frame ? `from frame ${item.from_frame}` : "from the start";
        const lines = [`K  = ${rowsOf(item.k, 3)}`, `D  = ${item.d.map(numberOf).join(", ")}`, `R  = ${rowsOf(item.r, 3)}`, `P  = ${rowsOf(item.p, 4)}`];
        if (item.binning_x || item.binning_y) lines.push(`binning ${item.binning_x} x ${item.binning_y}`);
        if (item.roi) lines.push(`ROI ${item.roi.width}x${item.roi.height} at ${item.roi.x_offset}, ${item.roi.y_offset}`);
        made.push(element("div", {class: "calibration"}, [
          element("h3", {text: camera.name}),
          element("p", {class: "muted", text: `${item.distortion_model || "no model"}, ${size}, frame ${item.frame_id || "(unnamed)"}, ${from}`}),
          element("p", {class: "muted", text: camera.calibration_topic}), element("pre", {text: lines.join("\n")})]));
      }
      const more = camera.calibrations.length - 8 + camera.calibrations_more;
      if (more > 0) made.push(element("p", {class: "muted", text: `${camera.name}: ${more} more changes; mp4ds info --intrinsics lists them`}));
    }
    place.replaceChildren(...made);
    return made.length > 0;
  }

  function transforms(place, data) {
    const head = [["Parent", {long: true}], ["Child", {long: true}], ["x, y, z, m", NUMBER], ["Rotation x, y, z, w", NUMBER]];
    const texts = values => values.map(value => value.toFixed(4)).join(", ");
    table(place, head, data.transforms.map(item => [item.parent, item.child, texts(item.translation), texts(item.rotation)]));
    return data.transforms.length > 0;
  }

  return {element, bytesText, stampText, dateText, summary, timing, topics, calibrations, transforms};
})();
