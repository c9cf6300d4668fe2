var a=()=>performance.timeOrigin+performance.now(),r=class extends Error{},t=e=>e instanceof Error?e.message||e.name:String(e);export{a,r as b,t as c};
