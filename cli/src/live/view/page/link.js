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

export class Link {
  constructor({ picture, news, state }) {
    this.handlers = { picture, news, state };
    this.waits = 500;
    this.over = false;
    this.connect();
  }

  connect() {
    const address = new URL('stream', location.href);
    address.protocol = location.protocol === 'https:' ? 'wss:' : 'ws:';
    const socket = new WebSocket(address);
    this.socket = socket;
    socket.binaryType = 'arraybuffer';
    let opened = false;
    socket.onopen = () => { opened = true; this.waits = 500; this.handlers.state('open'); };
    socket.onmessage = ({ data }) => {
      if (typeof data === 'string') {
        const news = JSON.parse(data);
        if (news.over) this.over = true;
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
      this.handlers.state(this.over ? 'over' : 'lost');
      // A socket does not report why it was refused. Another run may have another token.
      if (!opened && !this.over) fetch('health.json').then(({ status }) => { if (status === 401) this.handlers.state('locked'); }, () => {});
      // The program may be restarted at the same address.
      setTimeout(() => this.connect(), this.over ? 5000 : this.waits);
      this.waits = Math.min(this.waits * 2, 8000);
    };
  }

  /** Returns whether the request was sent. */
  send(request) {
    if (this.socket.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(request));
    return true;
  }
}
