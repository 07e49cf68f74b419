/* Puts the page together. data.js and the columns of each camera call in here. */
"use strict";
var mp4dsReport = (() => {
  // each as far as possible from the ones before, on light and on dark (farthest points in OKLab)
  const COLOURS = ["#3b82f6", "#f97316", "#10b981", "#a855f7", "#ef4444", "#eab308", "#786020", "#c8b0e8", "#b00080", "#f830c0",
    "#685898", "#5828f8", "#58e000", "#00d0f8", "#008800", "#008890", "#b07898", "#a09000", "#b03020", "#f880f8"];
  const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4, 8];
  const {element} = mp4dsTables, find = id => document.getElementById(id);
  const report = {plots: {}};
  let data, player, view, timeline;
  report.ready = new Promise((resolve, reject) => { report.done = resolve; report.failed = reject; });
  report.ready.catch(error => {
    find("message").textContent = `This page cannot be shown: ${error.message}`;
    find("message").hidden = false;
  });

  // ------------------------------------------------------------ cameras

  function cameraPanel(facts, number) {
    const colour = COLOURS[number % COLOURS.length];
    const video = facts.video ? element("video", {preload: "auto", playsinline: "", "aria-label": facts.name}) : null;
    if (video) video.muted = true;
    const still = facts.stills.length ? element("img", {alt: facts.name}) : null;
    const notice = element("div", {class: "nothing", text: `No picture: ${facts.note}`});
    notice.hidden = Boolean(video || still);
    const fit = element("div", {class: "fit"}, [...(video ? [video] : still ? [still] : []), notice]);
    fit.style.aspectRatio = `${facts.width / facts.shown[0]} / ${facts.height / facts.shown[1]}`;
    fit.style.setProperty("--ratio", String(facts.width / facts.height));
    const values = {}, readout = element("dl", {class: "readout"});
    for (const [key, name] of [["frame", "Frame"], ["stamp", "Stamp"], ["delay", "Delay"], ["log", "Recorded"]]) {
      values[key] = element("dd");
      readout.append(element("dt", {text: name}), values[key]);
    }
    const dot = element("span", {class: "dot"});
    dot.style.background = colour;
    const head = element("header", {title: "Step by this camera's frames"}, [dot, element("h3", {text: facts.name}),
      element("span", {class: "kind", text: `${facts.encoding} ${facts.width}×${facts.height} · ${facts.stored}`})]);
    const badge = element("span", {class: "badge"});
    if (still) head.append(badge);
    const close = element("button", {type: "button", class: "close", text: "×", title: "Hide this camera (h)", "aria-label": `Hide ${facts.name}`});
    head.append(close);
    const stage = element("div", {class: "stage", title: "Enlarge or restore (e)"}, [fit]);
    const panel = element("article", {class: "camera"}, [head, stage, readout]);
    if (facts.caption) panel.append(element("div", {class: "caption", text: `Shown ${facts.caption}`}));
    if (still) panel.append(element("div", {class: "caption", text: `Stills: ${facts.note}`}));
    find("cameras").append(panel);
    const camera = new mp4dsPlayer.Camera(facts, number, {video, still, badge, notice, panel, stage, close, values, colour, isSeen: true, onShown: told});
    head.addEventListener("click", () => lead(camera));
    close.addEventListener("click", event => { event.stopPropagation(); hide(camera, true); });
    stage.addEventListener("click", () => enlarge(camera));
    return camera;
  }

  /** Called when a camera shows another frame. */
  function told(camera) {
    const n = camera.shown, {values} = camera;
    values.frame.textContent = `${n} of ${camera.frames}`;
    values.stamp.textContent = mp4dsTables.stampText(camera.stamp[n]);
    values.stamp.title = mp4dsTables.dateText(camera.stamp[n]);
    values.log.textContent = mp4dsTables.stampText(camera.logTime[n]);
    values.log.title = mp4dsTables.dateText(camera.logTime[n]);
    values.delay.textContent = camera.facts.untimed || `${mp4dsPlots.numberText(Number(camera.logTime[n] - camera.stamp[n]) / 1e6)} ms`;
    if (camera.still) showStill(camera, n);
  }

  /** Show the still that is nearest to a frame. */
  function showStill(camera, n) {
    const nearest = camera.facts.stills.reduce((best, each) => Math.abs(each.frame - n) < Math.abs(best.frame - n) ? each : best);
    if (camera.still.getAttribute("src") !== nearest.file) camera.still.src = nearest.file;
    camera.badge.textContent = `still: frame ${nearest.frame}`;
  }

  /** Enlarge a camera to the width of the page; again: restore all. */
  function enlarge(camera) {
    const isLarge = camera && camera.panel.classList.contains("large");
    for (const each of player.cameras) each.panel.classList.toggle("large", each === camera && !isLarge);
    if (camera && !isLarge) {
      lead(camera);
      camera.panel.scrollIntoView({block: "nearest"});
    }
    redraw();
  }

  /** Hide a camera, so that its video costs nothing, or show it again. */
  function hide(camera, isHidden) {
    const shown = player.cameras.filter(each => !each.isHidden && each !== camera);
    if (isHidden && !shown.length) return;
    camera.panel.hidden = isHidden;
    camera.panel.classList.remove("large");
    camera.hide(isHidden, player.time);
    if (isHidden && player.lead === camera) lead(shown[0]);
    arrange();
  }

  /** Use the columns in which the cameras are largest while all of them are above the controls. */
  function fit(cameras) {
    const grid = find("cameras"), {style} = grid, gap = 14, count = cameras.length;
    const height = innerHeight - grid.offsetTop - find("transport").offsetHeight - 2 * gap;
    const ratio = Math.min(...cameras.map(({facts}) => facts.width / facts.height));
    const heightOf = ({panel, stage}) => [...panel.children].reduce((sum, child) => sum + (child === stage ? 0 : child.offsetHeight), 2);
    // pictures that are smaller still show too little: the page scrolls instead
    let best = {columns: count <= 1 ? 1 : count <= 4 ? 2 : count <= 9 ? 3 : 4, tall: "", width: 180};
    for (let columns = 1; columns <= count; columns++) {
      style.setProperty("--columns", String(columns));
      const rows = Math.ceil(count / columns), tall = (height + gap) / rows - gap - Math.max(...cameras.map(heightOf));
      const width = Math.min((grid.clientWidth + gap) / columns - gap, tall * ratio);
      if (width > best.width) best = {columns, tall: `${tall}px`, width};
    }
    style.setProperty("--columns", String(best.columns));
    style.setProperty("--tall", best.tall);
  }

  /** Lay out the visible cameras, and list the hidden ones. */
  function arrange() {
    const hidden = player.cameras.filter(camera => camera.isHidden), shown = player.cameras.filter(camera => !camera.isHidden);
    for (const camera of player.cameras) camera.close.hidden = shown.length <= 1;
    fit(shown);
    find("hidden").hidden = !hidden.length;
    find("hidden").replaceChildren("Hidden:", ...hidden.map(camera => {
      const dot = element("span", {class: "dot"}), show = element("button", {type: "button", title: "Show again"}, [dot, camera.facts.name]);
      dot.style.background = camera.colour;
      show.addEventListener("click", () => hide(camera, false));
      return show;
    }));
    redraw();
  }

  function redraw() {
    for (const plot of Object.values(report.plots)) plot.request();
    if (timeline) timeline.request();
  }

  function lead(camera) {
    player.lead = camera;
    find("lead").value = String(camera.number);
    for (const each of player.cameras) each.panel.classList.toggle("lead", each === camera && player.cameras.length > 1);
  }

  // ------------------------------------------------------------ plots

  function plotPanel(title) {
    const canvas = element("canvas"), value = element("span", {class: "value"});
    const head = element("header", {}, [element("h3", {text: title}), value]);
    find("plots").append(element("div", {class: "plot"}, [head, canvas]));
    return {canvas, value, head};
  }

  function timePlot(name, title, unit, {stems = false} = {}) {
    const {canvas, value, head} = plotPanel(title);
    const plot = new mp4dsPlots.TimePlot(canvas, value, view, {unit, stems, onTime: time => player.go(time)});
    if (!stems) {
      const button = element("button", {type: "button", text: "full range", "aria-pressed": "false"});
      button.addEventListener("click", () => {
        plot.isFull = !plot.isFull;
        button.setAttribute("aria-pressed", String(plot.isFull));
        button.textContent = plot.isFull ? "usual range" : "full range";
        plot.request();
      });
      head.append(button);
    }
    return report.plots[name] = plot;
  }

  /** Say under a plot which cameras are left out, and why: they would only distort its axis. */
  function leaveOut(plot, cameras) {
    const names = cameras.map(({facts}) => `${facts.name} (${facts.untimed})`);
    if (names.length) plot.canvas.after(element("p", {class: "hint", text: `Not shown: ${names.join(", ")}`}));
  }

  function addPlots() {
    const cameras = player.cameras.filter(camera => camera.position), shown = camera => () => camera.isSeen;
    const add = (plot, camera, y) => plot.add({name: camera.facts.name, colour: camera.colour, x: camera.position, y, shown: shown(camera)});
    const interval = timePlot("interval", "Interval between frames", "ms");
    const {canvas, value} = plotPanel("Jitter: interval minus median interval");
    const jitter = report.plots.jitter = new mp4dsPlots.Histogram(canvas, value, {unit: "ms"});
    const lost = timePlot("lost", "Lost frames (up), repeated or backward stamps (down)", "frames", {stems: true});
    const delay = timePlot("delay", "Record time minus header stamp", "ms");
    const stampless = cameras.filter(camera => !camera.hasStamps), strange = cameras.filter(camera => camera.facts.untimed);
    for (const camera of cameras) {
      if (!camera.facts.untimed) add(delay, camera, mp4dsColumns.delays(camera.logTime, camera.stamp));
      if (!camera.hasStamps) continue;
      add(interval, camera, camera.interval);
      const median = camera.timing.median || 0;
      jitter.add({name: camera.facts.name, colour: camera.colour, y: camera.interval.map(value => value - median), shown: shown(camera)});
      add(lost, camera, camera.lost.values);
    }
    for (const plot of [interval, jitter, lost]) leaveOut(plot, stampless);
    leaveOut(delay, strange);
    const reference = player.cameras[data.reference];
    if (reference) {
      const offset = timePlot("offset", `Offset to ${reference.facts.name}`, "ms");
      for (const camera of cameras) if (camera.offsets) add(offset, camera, camera.offsets);
      leaveOut(offset, strange);
    }
    const measures = new Set(cameras.flatMap(camera => Object.keys(camera.scores)));
    for (const measure of measures) {
      const plot = timePlot(`score ${measure}`, measure, "");
      for (const camera of cameras) if (camera.scores[measure]) add(plot, camera, camera.scores[measure]);
    }
    for (const plot of Object.values(report.plots)) plot.request();
  }

  function addLegend() {
    for (const camera of player.cameras) {
      const box = element("input", {type: "checkbox"}), dot = element("span", {class: "dot"});
      box.checked = true;
      dot.style.background = camera.colour;
      box.addEventListener("change", () => {
        camera.isSeen = box.checked;
        for (const plot of Object.values(report.plots)) plot.request();
      });
      find("legend").append(element("label", {}, [box, dot, element("span", {text: camera.facts.name})]));
    }
    find("legend").hidden = player.cameras.length < 2;
  }

  // ------------------------------------------------------------ controls

  function refresh() {
    const base = BigInt(data.base), seconds = player.time / 1e9;
    find("seconds").textContent = `${seconds.toFixed(6)} s`;
    find("date").textContent = mp4dsTables.dateText(base + BigInt(Math.round(player.time)));
    const play = find("play");
    play.classList.toggle("playing", player.isPlaying);
    play.setAttribute("aria-label", player.isPlaying ? "Pause" : "Play");
    for (const camera of player.cameras) {
      if (!camera.position) continue;
      const isAbsent = player.time < camera.position[0] - 2 * camera.usual || player.time > camera.position.at(-1) + 2 * camera.usual;
      camera.stage.classList.toggle("absent", isAbsent);
    }
    if (player.isPlaying && player.time > view.to) view.set(player.time, player.time + view.to - view.from);
    const line = find("timeline");
    line.setAttribute("aria-valuemax", String(player.end / 1e9));
    line.setAttribute("aria-valuenow", seconds.toFixed(3));
    for (const plot of Object.values(report.plots)) if ("now" in plot) { plot.now = player.time; plot.request(); }
    timeline.request();
  }

  /** Nanoseconds from the start for user input: seconds from the start, or ns since 1970. */
  function timeOf(text) {
    const clean = text.trim();
    if (/^\d{12,19}$/.test(clean)) return Number(BigInt(clean) - BigInt(data.base));
    if (/^\d{9,11}\.\d{1,9}$/.test(clean)) {
      const [whole, part] = clean.split(".");
      return Number(BigInt(whole) * 1000000000n + BigInt(part.padEnd(9, "0")) - BigInt(data.base));
    }
    const seconds = Number(clean.replace(/\s*s$/, ""));
    return clean && Number.isFinite(seconds) ? seconds * 1e9 : null;
  }

  /** The time given in the address as #t=, or null. */
  function timeOfAddress() {
    let asked = null;
    try { asked = /^#t=(.+)$/.exec(decodeURIComponent(location.hash)); } catch { /* no text: it asks for nothing */ }
    return asked && timeOf(asked[1]);
  }

  function goTo(time) {
    player.pause();
    player.go(time);
    if (player.time < view.from || player.time > view.to) view.all();
  }

  function addControls() {
    for (const speed of SPEEDS) find("speed").append(element("option", {value: speed, text: `${speed} ×`}));
    find("speed").value = "1";
    find("speed").addEventListener("change", event => { player.speed = Number(event.target.value); });
    for (const camera of player.cameras) find("lead").append(element("option", {value: camera.number, text: camera.facts.name}));
    find("lead").addEventListener("change", event => lead(player.cameras[Number(event.target.value)]));
    if (player.cameras.length) lead(player.cameras[0]);
    find("play").addEventListener("click", () => player.toggle());
    find("back").addEventListener("click", () => player.step(-1));
    find("forward").addEventListener("click", () => player.step(1));
    find("goto").addEventListener("submit", event => {
      event.preventDefault();
      const time = timeOf(find("goto-time").value);
      if (time !== null) goTo(time);
    });
    addEventListener("hashchange", () => { const time = timeOfAddress(); if (time !== null) goTo(time); });
    document.addEventListener("keydown", event => {
      if (event.target.closest("input[type=text], select") || event.ctrlKey || event.metaKey || event.altKey) return;
      const far = event.shiftKey ? 10 : 1;
      const actions = {" ": () => player.toggle(), ArrowLeft: () => player.step(-far), ArrowRight: () => player.step(far),
        Home: () => player.go(0), End: () => player.go(player.end),
        e: () => player.lead && enlarge(player.lead), Escape: () => enlarge(null), h: () => player.lead && hide(player.lead, true)};
      const action = actions[event.key];
      if (!action) return;
      event.preventDefault();
      action();
    });
    find("options").addEventListener("click", event => {
      event.currentTarget.setAttribute("aria-expanded", String(find("transport").classList.toggle("open")));
    });
    addEventListener("resize", arrange);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  }

  // ------------------------------------------------------------ loading

  const waiting = new Map();

  /** Receives the columns of a camera; called by report/columns-N.js. */
  report.columns = (number, columns) => waiting.get(number)(columns);

  function load(camera) {
    return new Promise((resolve, reject) => {
      waiting.set(camera.number, packed => {
        const count = packed.frames, base = BigInt(data.base);
        const stamp = mp4dsColumns.decode(packed.stamp, count), logTime = mp4dsColumns.decode(packed.log_time, count);
        const interval = mp4dsColumns.intervals(stamp), timing = mp4dsColumns.timing(interval);
        const scores = {};
        for (const [name, text] of Object.entries(packed.scores)) scores[name] = mp4dsColumns.decodeFloats(text);
        camera.take({
          stamp, logTime, interval, timing, scores, hasStamps: stamp.some(Boolean),
          lost: {values: timing.lost, reduction: new mp4dsPlots.Reduction(timing.lost)},
          position: mp4dsColumns.positions(data.axis === "stamp" ? stamp : logTime, base),
          ticks: packed.ticks ? Float64Array.from(mp4dsColumns.decode(packed.ticks, count), Number) : null,
        });
        resolve();
      });
      const script = element("script", {src: camera.facts.columns});
      script.addEventListener("error", () => reject(new Error(`${camera.facts.columns} is missing`)));
      document.head.append(script);
    });
  }

  async function start() {
    document.title = `${data.name} - mp4ds report`;
    find("name").textContent = data.name;
    find("footer").textContent = `mp4ds ${data.version}. Cameras are synchronised by their ${data.axis === "stamp" ? "header stamps" : "record times"}.`;
    const cameras = data.cameras.map(cameraPanel);
    player = report.player = new mp4dsPlayer.Player(cameras, 0);
    arrange();
    await Promise.all(cameras.map(load));
    const reference = cameras[data.reference];
    for (const camera of cameras) {
      if (reference && camera !== reference && !camera.facts.untimed) camera.offsets = mp4dsColumns.offsets(camera.stamp, reference.stamp);
    }
    player.end = Math.max(0, ...cameras.map(camera => camera.position.at(-1)));
    view = report.view = new mp4dsPlots.View(player.end);
    timeline = new mp4dsTimeline.Timeline(find("timeline"), player, view);
    const facts = data.summary;
    find("subtitle").textContent = [facts.start && mp4dsTables.dateText(BigInt(facts.start)).replace(/\.\d+/, ""), facts.format && `from ${facts.format}`, (facts.sources || []).slice(0, 4).join(", ")].filter(Boolean).join(" · ");
    const length = facts.start ? Number(BigInt(facts.end) - BigInt(facts.start)) / 1e9 : player.end / 1e9;
    mp4dsTables.summary(find("summary"), data, length);
    find("timing-hint").textContent = mp4dsTables.timing(find("timing"), cameras, reference);
    mp4dsTables.topics(find("topics"), data);
    find("calibration-section").hidden = !mp4dsTables.calibrations(find("calibrations"), data);
    find("transform-section").hidden = !mp4dsTables.transforms(find("transforms"), data);
    find("notes").replaceChildren(...data.notes.map(text => element("li", {text})));
    find("note-section").hidden = !data.notes.length;
    addControls();
    addLegend();
    addPlots();
    player.listeners.push(refresh);
    player.go(timeOfAddress() ?? 0);
    timeline.draw();  // the controls now have their height
    arrange();
  }

  /** Receives the page's data; called by report/data.js. */
  report.dataset = facts => {
    data = report.data = facts;
    start().then(report.done, report.failed);
  };

  /** Resolves when every camera shows the frame it should. */
  report.settled = async () => {
    await report.ready;
    while (!player.isSettled) await new Promise(resolve => setTimeout(resolve, 25));
    return true;
  };

  return report;
})();
