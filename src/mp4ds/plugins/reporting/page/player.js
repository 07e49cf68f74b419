/* All cameras on one clock. A frame is known by its number; its video is sought to the middle of
   the time for which that frame is shown. Times are nanoseconds from the start. */
"use strict";
var mp4dsPlayer = (() => {
  const {lastAtMost} = mp4dsColumns;
  const HELD = 2e9;       // during longer intervals the video is paused
  const SLACK = 0.2e9;    // how far the clock may be ahead of the slowest video
  const SLOWER = 500, FASTER = 2000;  // ms of waiting, and of not waiting, that change the pace by a factor e
  const LEAST_PACE = 1 / 16;          // the slowest rate browsers support
  const LATE = 500;       // ms after which a frame sought again is assumed to be shown
  const LOST = 5000;      // ms for any other frame, if the browser does not report it

  class Camera {
    constructor(facts, number, parts) {
      Object.assign(this, {facts, number, ...parts});
      this.shown = this.wanted = -1;
      this.busy = this.isReady = this.isBroken = this.isHidden = false;
    }

    /** Takes the columns: stamp and logTime (BigInt64Array), position and ticks (numbers). */
    take(columns) {
      Object.assign(this, columns);
      const mean = (this.position.at(-1) - this.position[0]) / Math.max(1, this.frames - 1);
      this.usual = this.timing.median ? this.timing.median * 1e6 : mean;
      if (this.video && this.ticks) this.open();
    }

    open() {
      const video = this.video;
      video.addEventListener("loadedmetadata", () => { this.isReady = true; if (this.wanted >= 0) this.seek(); });
      for (const event of ["playing", "pause", "error"]) video.addEventListener(event, () => { this.isStarting = false; });
      video.addEventListener("seeked", () => this.seeked());
      video.addEventListener("error", () => {
        this.isBroken = true;
        this.busy = false;
        const detail = video.error && video.error.message ? ` (${video.error.message})` : "";
        this.say(`This browser cannot play ${this.facts.file}${detail}. mp4ds pack DATASET -o NEW --view h264 makes one that every browser plays.`);
      });
      if (video.requestVideoFrameCallback) this.watch();
      video.src = this.facts.video;
    }

    watch() {
      this.video.requestVideoFrameCallback((_, metadata) => {
        this.isPresented = true;
        this.presented = this.frameOfTick(metadata.mediaTime * 1e6);
        this.show(this.presented);
        this.watch();
      });
    }

    say(text) {
      this.notice.textContent = text;
      this.notice.hidden = false;
    }

    get isPlayable() { return Boolean(this.isReady && !this.isBroken && !this.isHidden); }
    get frames() { return this.position.length; }
    get isSettled() { return !this.video || this.isHidden || this.isBroken || !this.ticks || this.wanted < 0 || (!this.busy && this.shown === this.wanted); }

    frameAt(time) { return lastAtMost(this.position, time); }

    /** The frame with the nearest presentation time, microseconds. */
    frameOfTick(tick) {
      const n = Math.max(0, lastAtMost(this.ticks, tick));
      const hasNext = n + 1 < this.ticks.length && this.ticks[n + 1] - tick < tick - this.ticks[n];
      return hasNext ? n + 1 : n;
    }

    /** Video time, in seconds, at the middle of a frame. */
    middle(n) {
      const next = n + 1 < this.ticks.length ? this.ticks[n + 1] : Math.max(this.video.duration * 1e6 || 0, this.ticks[n] + 2);
      return (this.ticks[n] + Math.min(next, this.ticks[n] + HELD / 1e3)) / 2e6;
    }

    /** Where the video should be at a time, in seconds of video time. */
    secondsAt(time) {
      const n = Math.max(0, this.frameAt(time)), next = n + 1;
      if (next >= this.frames) return this.ticks[n] / 1e6 + (time - this.position[n]) / 1e9;
      const span = this.position[next] - this.position[n];
      const part = span ? Math.min(1, Math.max(0, (time - this.position[n]) / span)) : 0;
      return (this.ticks[n] + part * (this.ticks[next] - this.ticks[n])) / 1e6;
    }

    /** How far the clock may advance from a time, given the frame on screen. */
    reach(time, slack) {
      if (!this.isPlayable) return Infinity;
      const due = Math.max(0, this.frameAt(time)), {shown} = this;
      const isMoving = this.busy || this.isStarting || this.video.seeking;
      if (shown < 0 || (isMoving && shown > due && this.position[shown] > time + slack)) return time;
      return shown + 1 < this.frames ? this.position[shown + 1] + slack : Infinity;
    }

    /** Seek to a frame, once any earlier seek is done. */
    want(n) {
      this.wanted = n;
      if (!this.video || !this.ticks || this.isBroken || this.isHidden) this.show(n);
      else if (this.isReady && !this.busy) this.seek();
    }

    seek() {
      if (this.wanted === this.shown && this.shown === this.sought) return;
      this.busy = true;
      this.isPresented = false;
      this.sought = this.wanted;
      this.video.currentTime = this.middle(this.sought);
    }

    seeked() {
      if (!this.busy) return;
      this.busy = false;
      if (!this.video.paused) return;
      if (this.wanted !== this.sought && !this.isFollowing) { this.seek(); return; }
      const sought = this.sought;
      // no new picture is presented if the one sought is already on screen
      const settle = () => {
        if (this.busy || this.sought !== sought || !this.video.paused) return;
        if (!this.isPresented) this.show(sought);
        else if (this.shown !== sought) this.seek();  // only an earlier picture was reported, late
      };
      if (this.video.requestVideoFrameCallback) setTimeout(settle, this.presented === sought ? LATE : LOST); else settle();
    }

    show(n) {
      if (this.shown === n) return;
      this.shown = n;
      this.onShown(this);
    }

    /** Follow the running clock. */
    follow(time, speed) {
      this.isFollowing = true;
      if (!this.isPlayable) { this.wanted = Math.max(0, this.frameAt(time)); this.show(this.wanted); return; }
      const n = this.frameAt(time), video = this.video;
      const until = n + 1 < this.frames ? this.position[n + 1] : this.position[n] + this.usual;
      const isHeld = n < 0 || time >= until || (until - this.position[n] > HELD && time < until);
      if (isHeld) {
        if (!video.paused) { video.pause(); this.sought = -1; }
        if (this.wanted !== Math.max(0, n) || this.shown !== this.wanted) this.want(Math.max(0, n));
        return;
      }
      this.wanted = n;
      if (!video.requestVideoFrameCallback && !video.seeking) this.show(this.frameOfTick(video.currentTime * 1e6));
      const late = this.secondsAt(time) - video.currentTime, far = Math.max(1, speed);
      const isShown = this.shown >= n && this.position[this.shown] <= time + SLACK * far;
      if (this.busy || video.seeking) return;
      if (video.ended) {
        if (this.shown !== n) this.want(n);
      } else if (video.paused) {
        if (isShown && late < -0.03) return;  // until the clock gets there
        if (Math.abs(late) > 0.03) video.currentTime = this.secondsAt(time);
        this.rate(0);  // until all have started
        this.isStarting = true;
        video.play().catch(() => {});
      } else if (late < -0.15 * far) {  // the clock waits, for this video too if it shows too little
        video.pause();
        this.sought = -1;
        if (!isShown) this.want(n);
      } else if (late > 0.3 * far) {
        video.currentTime = this.secondsAt(time);
      } else {
        this.rate(speed * (1 + Math.max(-0.15, Math.min(0.15, late / far))));
      }
    }

    rate(value) {
      const rounded = Math.max(0.0625, Math.min(16, Math.round(value * 100) / 100));
      if (this.video.playbackRate !== rounded) this.video.playbackRate = rounded;
    }

    /** Hide it, or show it again at a time. */
    hide(isHidden, time) {
      this.isHidden = isHidden;
      this.stop();
      if (this.position) this.want(Math.max(0, this.frameAt(time)));
    }

    stop() {
      if (this.video && !this.video.paused) this.video.pause();
      this.busy = this.isFollowing = false;
      this.sought = -1;
    }
  }

  class Player {
    constructor(cameras, end) {
      Object.assign(this, {cameras, end, time: 0, speed: 1, isPlaying: false, lead: cameras[0] || null, listeners: []});
    }

    tell() { for (const listener of this.listeners) listener(); }

    /** Show a time; if `camera` is given, it shows exactly frame `n`. */
    go(time, camera = null, n = 0) {
      this.time = Math.max(0, Math.min(this.end, time));
      for (const each of this.cameras) {
        if (!each.position) continue;
        if (this.isPlaying) each.stop();
        else each.want(each === camera ? n : Math.max(0, each.frameAt(this.time)));
      }
      this.tell();
    }

    /** Step forward or back by frames of the leading camera. */
    step(count) {
      const lead = this.lead;
      if (!lead || !lead.position) return;
      this.pause();
      const n = Math.max(0, Math.min(lead.frames - 1, Math.max(0, lead.wanted) + count));
      this.go(lead.position[n], lead, n);
    }

    play() {
      if (this.isPlaying || !this.cameras.length) return;
      if (this.time >= this.end) this.time = 0;
      this.isPlaying = true;
      this.pace = 1;
      this.current = LEAST_PACE;
      this.last = performance.now();
      requestAnimationFrame(now => this.advance(now));
      this.tell();
    }

    pause() {
      if (!this.isPlaying) return;
      this.isPlaying = false;
      for (const camera of this.cameras) camera.stop();
      this.go(this.time);
    }

    toggle() { if (this.isPlaying) this.pause(); else this.play(); }

    /** The clock runs, but not ahead of any video: it waits, then slows down. */
    advance(now) {
      if (!this.isPlaying) return;
      const passed = Math.max(0, now - this.last), slack = SLACK * Math.max(1, this.speed);
      let next = this.time + passed * 1e6 * this.speed * this.current, isLate = false;
      this.last = now;
      for (const camera of this.cameras) {
        if (!camera.position) continue;
        const most = Math.max(this.time, camera.reach(this.time, slack));
        if (most >= next) continue;
        next = most;
        isLate = true;
      }
      const pace = this.pace * Math.exp(isLate ? -passed / SLOWER : passed / FASTER);
      // no video may get further than this before the next update
      this.pace = Math.max(LEAST_PACE, Math.min(1, pace, SLACK / 1e6 / (passed || 1)));
      this.time = Math.min(next, this.end);
      if (this.time >= this.end) { this.pause(); return; }
      for (const camera of this.cameras) if (camera.position) camera.follow(this.time, this.speed * this.current);
      // videos already playing must not run ahead of those about to start
      const isStarting = this.cameras.some(camera => camera.isStarting && camera.isPlayable);
      this.current = isStarting ? LEAST_PACE : this.pace;
      this.tell();
      requestAnimationFrame(later => this.advance(later));
    }

    get isSettled() { return this.cameras.every(camera => camera.isSettled); }
  }

  return {Camera, Player};
})();
