/* The time line: a lane for each camera, the time over them; dragged to scrub, zoomed by the wheel. */
"use strict";
var mp4dsTimeline = (() => {
  class Timeline {
    constructor(canvas, player, view) {
      Object.assign(this, {canvas, player, view});
      view.listeners.push(() => this.request());
      const timeAt = event => {
        const box = canvas.getBoundingClientRect();
        return view.from + Math.max(0, Math.min(1, (event.clientX - box.left) / box.width)) * (view.to - view.from);
      };
      let isDown = false, wasPlaying = false;
      canvas.addEventListener("pointerdown", event => {
        isDown = true;
        wasPlaying = player.isPlaying;
        player.pause();
        canvas.setPointerCapture(event.pointerId);
        player.go(timeAt(event));
      });
      canvas.addEventListener("pointermove", event => { if (isDown) player.go(timeAt(event)); });
      canvas.addEventListener("pointerup", () => { isDown = false; if (wasPlaying) player.play(); });
      canvas.addEventListener("dblclick", () => view.all());
      canvas.addEventListener("wheel", event => {
        event.preventDefault();
        const span = view.to - view.from;
        if (event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY)) view.set(view.from + span * (event.deltaX || event.deltaY) / 1000, view.to + span * (event.deltaX || event.deltaY) / 1000);
        else view.zoom(timeAt(event), Math.exp(event.deltaY / 300));
      }, {passive: false});
    }

    request() {
      if (this.pending) return;
      this.pending = requestAnimationFrame(() => { this.pending = 0; this.draw(); });
    }

    /** The lanes change only with the view; the time cursor moves over them. */
    draw() {
      const {player, view} = this, lanes = player.cameras.length, row = Math.max(3, Math.min(8, Math.floor(48 / lanes))), top = 26;
      const [context, width, height] = mp4dsPlots.prepare(this.canvas, top + lanes * row + 4), colours = mp4dsPlots.theme();
      const xOf = time => (time - view.from) / (view.to - view.from || 1) * width;
      const marks = mp4dsPlots.ticks(view.from / 1e9, view.to / 1e9, width / 110), digits = mp4dsPlots.digitsOf(marks);
      context.fillStyle = colours.text;
      context.strokeStyle = colours.line;
      context.textBaseline = "middle";
      for (const mark of marks) {
        const x = xOf(mark * 1e9), text = mp4dsPlots.timeText(mark, digits);
        context.textAlign = x < 24 ? "left" : x > width - 24 ? "right" : "center";
        context.fillText(text, x, 7);
        context.beginPath(); context.moveTo(x, top - 11); context.lineTo(x, height); context.stroke();
      }
      player.cameras.forEach((camera, lane) => { if (camera.position) this.lane(context, camera, top + lane * row, row - 2, width, colours); });
      const x = Math.max(5, Math.min(width - 5, xOf(player.time)));  // whole at both ends
      context.fillStyle = colours.accent;
      context.fillRect(x - 1, top - 7, 2, height - top + 7);
      context.beginPath(); context.arc(x, top - 7, 5, 0, 7); context.fill();
    }

    lane(context, camera, y, height, width, colours) {
      const {view} = this, span = (view.to - view.from) / width, reach = Math.max(1.5 * camera.usual, span);
      context.fillStyle = camera.colour;
      let first = mp4dsColumns.lastAtMost(camera.position, view.from) + 1, from = -1;
      const missing = [];
      for (let px = 0; px <= width; px++) {
        const time = view.from + (px + 1) * span, n = mp4dsColumns.lastAtMost(camera.position, time);
        const isThere = px < width && n >= 0 && time - camera.position[n] <= reach;
        if (isThere && from < 0) from = px;
        if (!isThere && from >= 0) { context.fillRect(from, y, px - from, height); from = -1; }
        if (n + 1 > first) { if (camera.lost.reduction.range(first, n + 1)[1] > 0) missing.push(px); first = n + 1; }
      }
      context.fillStyle = colours.warn;
      for (const px of missing) context.fillRect(px, y, 1, height);
    }
  }

  return {Timeline};
})();
