"use strict";
// Figures are drawn at two pixels a point at least, so that print and enlarged pages are sharp.
(function () {
  const native = Object.getOwnPropertyDescriptor(window, "devicePixelRatio");
  Object.defineProperty(window, "devicePixelRatio", {
    configurable: true,
    get: () => Math.max(2, native && native.get ? native.get.call(window) : 1),
  });
})();
