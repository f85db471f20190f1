// Connection: receives pictures and news, sends requests. Each picture is acknowledged, so that a slow page gets fewer.

/** Header and parts of a picture: see picture.rs. */
export function decode(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const parts = {};
  let at = 4 + length;
  for (const [name, bytes] of header.parts) {
    parts[name] = new Uint8Array(buffer, at, bytes);
    at += bytes;
  }
  return { header, parts };
}

/** Typed array from the bytes of a part, which may be unaligned. */
export const floats = bytes => new Float32Array(bytes.slice().buffer);
export const words = bytes => new Uint16Array(bytes.slice().buffer);

/** Longest silence of a connection, ms. The program sends something every two seconds. */
const SILENCE = 10000;
/** Silence after which no requests are sent, ms. */
const DOUBT = 4000;

export class Link {
  constructor({ picture, news, state }) {
    this.handlers = { picture, news, state };
    this.waits = 500;
    this.over = false;
    this.connect();
    setInterval(() => this.leaveSilence(), 1000);
  }

  connect() {
    const address = new URL('stream', location.href);
    address.protocol = location.protocol === 'https:' ? 'wss:' : 'ws:';
    const socket = new WebSocket(address);
    this.socket = socket;
    this.heard = performance.now();
    socket.binaryType = 'arraybuffer';
    let opened = false;
    socket.onopen = () => { opened = true; this.waits = 500; this.handlers.state('open'); };
    socket.onmessage = ({ data }) => {
      this.heard = performance.now();
      if (typeof data === 'string') {
        const news = JSON.parse(data);
        if (news.over) this.over = true;
        if (news.hello) this.over = false;
        this.handlers.news(news);
        return;
      }
      try {
        this.handlers.picture(decode(data));
      } finally {
        this.send({ do: 'seen' });
      }
    };
    socket.onclose = () => {
      if (opened || this.over) this.handlers.state(this.over ? 'over' : 'lost');
      else this.explain(socket);
      // The program may be restarted at the same address.
      setTimeout(() => this.connect(), this.over ? 5000 : this.waits);
      this.waits = Math.min(this.waits * 2, 8000);
    };
  }

  /** Finds out why a connection was refused, which its socket does not report. Another run may have another token. */
  async explain(socket) {
    let state = 'lost';
    try {
      const answer = await fetch('health.json');
      if (answer.status === 401) state = 'locked';
      else if (answer.ok && (await answer.json()).is_full) state = 'full';
    } catch { /* The program does not answer. */ }
    // The answer is too late if the page has connected again.
    if (this.socket === socket) this.handlers.state(state);
  }

  /** Replaces a connection that sends nothing: a network that is gone closes no socket. */
  leaveSilence() {
    if (this.socket.readyState > WebSocket.OPEN || performance.now() - this.heard < SILENCE) return;
    this.socket.onopen = this.socket.onmessage = this.socket.onclose = null;
    this.socket.close();
    this.handlers.state('lost');
    this.connect();
  }

  /** Returns whether the request was sent. It is not sent into a silence: nobody would tell the user that it was lost. */
  send(request) {
    if (this.socket.readyState !== WebSocket.OPEN || performance.now() - this.heard > DOUBT) return false;
    this.socket.send(JSON.stringify(request));
    return true;
  }
}
