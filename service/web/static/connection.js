// The websocket: comes back by itself, keeps messages in order, and pairs commands with their answers.

import { decode } from "./protocol.js";

const FIRST_RETRY_MS = 500, LONGEST_RETRY_MS = 5000;
const TOKEN_KEY = "corridor.token";

const findToken = () => {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given) {
    sessionStorage.setItem(TOKEN_KEY, given);
    history.replaceState(null, "", location.pathname);
  }
  return sessionStorage.getItem(TOKEN_KEY) ?? "";
};

export class Connection {
  /** on: {message type: function(message)}, "open" and "closed" besides. */
  constructor(on) {
    this.on = on;
    this.token = findToken();
    this.mayControl = false;
    this.role = ""; // of the token that was shown
    this.retry_ms = FIRST_RETRY_MS;
    this.number = 0;
    this.waiting = new Map(); // number -> what takes the answer
    this.bytes = 0;
    this.order = Promise.resolve();
  }

  open() {
    const scheme = location.protocol === "https:" ? "wss:" : "ws:";
    this.socket = new WebSocket(`${scheme}//${location.host}/ws`);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => {
      this.retry_ms = FIRST_RETRY_MS;
      this.#tell({ type: "open" });
      if (this.token) this.showToken(this.token);
    };
    this.socket.onmessage = ({ data }) => {
      this.bytes += typeof data === "string" ? data.length : data.byteLength;
      const decoded = decode(data);
      this.order = this.order.then(() => decoded).then((message) => this.#tell(message)).catch(console.error);
    };
    this.socket.onclose = ({ reason }) => {
      [this.mayControl, this.role] = [false, ""];
      for (const settle of this.waiting.values()) settle({ ok: false, error: "the connection was lost meanwhile" });
      this.waiting.clear();
      this.order = this.order.then(() => this.#tell({ type: "closed", reason }));
      setTimeout(() => this.open(), this.retry_ms);
      this.retry_ms = Math.min(2 * this.retry_ms, LONGEST_RETRY_MS);
    };
  }

  showToken(token) {
    this.token = token;
    this.#send({ type: "token", token });
  }

  command(verb, request = {}) {
    return this.#ask({ type: "command", verb, request });
  }

  resource(request) {
    return this.#ask({ type: "resource", ...request });
  }

  #ask(message) {
    this.number += 1;
    const n = this.number;
    return new Promise((settle) => {
      this.waiting.set(n, settle);
      if (!this.#send({ ...message, n })) {
        this.waiting.delete(n);
        settle({ ok: false, error: "there is no connection to the vehicle" });
      }
    });
  }

  #send(message) {
    if (this.socket?.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }

  /** Or forget one that was refused. */
  #keepToken({ may_control, role }) {
    [this.mayControl, this.role] = [may_control, role];
    if (!role) this.token = "";
    sessionStorage.setItem(TOKEN_KEY, this.token);
  }

  #tell(message) {
    if (message.type === "answer") {
      this.waiting.get(message.n)?.(message.body);
      this.waiting.delete(message.n);
      return;
    }
    if (message.type === "access") this.#keepToken(message);
    this.on[message.type]?.(message);
  }
}
