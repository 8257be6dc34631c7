// What a stream's latency, service time and rate were, over the last meshes that came.

const REMEMBERED = 240; // latencies that the figures shown are taken over

export class Figures {
  constructor() {
    this.latencies = [];
    this.services = [];
    this.arrivals = [];
    this.due = this.seen = 0; // frames so far, and those of them that came
  }

  /** Meshes came, `due` frames after the last, `latency` [ms] after their pose left, `service` of them in the service. */
  note(due, latency, service) {
    const now = performance.now();
    this.due += Math.max(due, 1);
    this.seen += 1;
    this.latencies.push(latency);
    this.services.push(service);
    this.arrivals.push(now);
    if (this.latencies.length > REMEMBERED) { this.latencies.shift(); this.services.shift(); }
    while (this.arrivals[0] < now - 1000) this.arrivals.shift();
  }

  /** Latency, median and 95th percentile, and the service's own part of it [ms]; frames dropped of those due; meshes
   * that came within the last second. */
  read() {
    const { latencies, services, due, seen, arrivals } = this;
    const [median, most, service] = [quantile(latencies, 0.5), quantile(latencies, 0.95), quantile(services, 0.5)];
    return { median, most, service, dropped: due - seen, due, rate: arrivals.length };
  }
}

function quantile(values, share) {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.min(Math.floor(share * sorted.length), sorted.length - 1)];
}
