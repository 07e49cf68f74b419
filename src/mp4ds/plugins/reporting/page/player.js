/* All cameras on one clock. A frame is known by its number; its video is sought to the middle of
   the time for which that frame is shown. Times are nanoseconds from the start. */
"use strict";
var mp4dsPlayer = (() => {
  const {lastAtMost} = mp4dsColumns;
  const HELD = 2e9;       // a longer interval is waited through with the video paused
  const SLACK = 0.2e9;    // that the clock may be away from what the slowest video shows
  const SLOWER = 500, FASTER = 2000;  // ms of waiting, and of none, that change the pace by e
  const LEAST_PACE = 1 / 16;          // that browsers play at
  const LATE = 500;       // ms after which a frame that was sought, and was there before, is taken for shown
  const LOST = 5000;      // and another one, if the browser does not say that it is

  class Camera {
    constructor(facts, number, parts) {
      Object.assign(this, {facts, number, ...parts});
      this.shown = this.wanted = -1;
      this.busy = this.isReady = this.isBroken = this.isHidden = false;
    }

    /** Take the columns: stamp and logTime (BigInt64Array), position and ticks (numbers). */
    take(columns) {
      Object.assign(this, columns);
      const mean = (this.position.at(-1) - this.position[0]) / Math.max(1, this.frames - 1);
      this.usual = this.facts.timing.median_ms ? this.facts.timing.median_ms * 1e6 : mean;
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
        this.say(`This browser cannot play ${this.facts.file}${detail}. mp4ds report --proxies all makes videos that every browser plays.`);
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

    /** The frame whose presentation time is nearest, microseconds. */
    frameOfTick(tick) {
      const n = Math.max(0, lastAtMost(this.ticks, tick));
      const hasNext = n + 1 < this.ticks.length && this.ticks[n + 1] - tick < tick - this.ticks[n];
      return hasNext ? n + 1 : n;
    }

    /** Seconds of the video in the middle of a frame. */
    middle(n) {
      const next = n + 1 < this.ticks.length ? this.ticks[n + 1] : Math.max(this.video.duration * 1e6 || 0, this.ticks[n] + 2);
      return (this.ticks[n] + Math.min(next, this.ticks[n] + HELD / 1e3)) / 2e6;
    }

    /** Where the video is to be at a time, in seconds of the video. */
    secondsAt(time) {
      const n = Math.max(0, this.frameAt(time)), next = n + 1;
      if (next >= this.frames) return this.ticks[n] / 1e6 + (time - this.position[n]) / 1e9;
      const span = this.position[next] - this.position[n];
      const part = span ? Math.min(1, Math.max(0, (time - this.position[n]) / span)) : 0;
      return (this.ticks[n] + part * (this.ticks[next] - this.ticks[n])) / 1e6;
    }

    /** How far the clock may go on from a time, by the frame on the screen. */
    reach(time, slack) {
      if (!this.isPlayable) return Infinity;
      const due = Math.max(0, this.frameAt(time)), {shown} = this;
      const isMoving = this.busy || this.isStarting || this.video.seeking;
      if (shown < 0 || (isMoving && shown > due && this.position[shown] > time + slack)) return time;
      return shown + 1 < this.frames ? this.position[shown + 1] + slack : Infinity;
    }

    /** Seek to a frame, or as soon as the seek before is done. */
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
      // no picture is presented where the one that is sought is on the screen already
      const settle = () => {
        if (!this.busy && !this.isPresented && this.sought === sought && this.video.paused) this.show(sought);
      };
      if (this.video.requestVideoFrameCallback) setTimeout(settle, this.presented === sought ? LATE : LOST); else settle();
    }

    show(n) {
      if (this.shown === n) return;
      this.shown = n;
      this.onShown(this);
    }

    /** Go along while the clock runs. */
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
      } else if (late < -0.15 * far) {  // the clock waits, for this one too if it shows too little
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

    /** Leave it out, or show it again at a time. */
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

    /** Show a time; of `camera`, if one is given, just the frame `n`. */
    go(time, camera = null, n = 0) {
      this.time = Math.max(0, Math.min(this.end, time));
      for (const each of this.cameras) {
        if (!each.position) continue;
        if (this.isPlaying) each.stop();
        else each.want(each === camera ? n : Math.max(0, each.frameAt(this.time)));
      }
      this.tell();
    }

    /** So many frames of the leading camera on, or back. */
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

    /** The clock runs on, but not away from what a video shows: it waits, and then goes slower. */
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
      // until the page looks again, no video is to get further than that
      this.pace = Math.max(LEAST_PACE, Math.min(1, pace, SLACK / 1e6 / (passed || 1)));
      this.time = Math.min(next, this.end);
      if (this.time >= this.end) { this.pause(); return; }
      for (const camera of this.cameras) if (camera.position) camera.follow(this.time, this.speed * this.current);
      // videos that already play are not to run away from those that are about to
      const isStarting = this.cameras.some(camera => camera.isStarting && camera.isPlayable);
      this.current = isStarting ? LEAST_PACE : this.pace;
      this.tell();
      requestAnimationFrame(later => this.advance(later));
    }

    get isSettled() { return this.cameras.every(camera => camera.isSettled); }
  }

  return {Camera, Player};
})();
